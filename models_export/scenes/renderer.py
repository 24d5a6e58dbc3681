"""Draws a scene with OpenGL: pictures, depth and instance numbers in one pass, silhouettes in a second.

Rows come out top first: the projection turns the picture upside down for OpenGL, so that nothing has to be flipped later.
"""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from models_export.scenes import shaders
from models_export.scenes.drawable import Drawable, noise_texture, set_values
from models_export.scenes.film import Film
from models_export.scenes.lamplight import LampPainter, Lamps
from models_export.scenes.light import Light
from models_export.scenes.mesh import Array, Mesh
from models_export.scenes.projection import clip_from_cam, crop_clip, in_view, sun_clip
from service.errors import QuadliftError
from service.geometry.camera import Camera

TILE_PX = (128, 64)
"""Width and height of a silhouette's tile."""
_TILES_ACROSS = 8
_SHADOW_PX = 2048
_SHADOW_REACH_M = 62.0
_BIAS = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1.0]])
GL_REMEDY = (
    "Rendering needs EGL and an OpenGL 3.3 driver: on Debian or Ubuntu install the packages "
    "libegl1 libgl1-mesa-dri libgles2 (Mesa's software driver is enough)."
)


@dataclass(frozen=True, eq=False)
class Shot:
    """What one camera sees."""

    image: NDArray[np.uint8]
    """(H, W, 3) RGB."""
    instance: NDArray[np.uint16]
    """(H, W): 0, or 1 + the index of the road user seen there."""
    depth: NDArray[np.uint16]
    """(H, W): metres along the optical axis times 256, rounded; 0 for sky and beyond 255 m."""


@dataclass(frozen=True, eq=False)
class Cast:
    """Who is where at one instant; N road users in the order of instance numbers."""

    ids: list[int]
    placed: dict[int, Array]
    """``world_from_model`` (4, 4) by id."""
    boxes: Array
    """(N, 6): x, y, yaw, length, width, height of the ground underneath; metres and radians."""
    lamps: Lamps


def open_context() -> moderngl.Context:
    """A context without a window. Raises QuadliftError naming the system packages when there is no EGL or driver."""
    try:
        return moderngl.create_context(standalone=True, backend="egl", require=330)  # type: ignore[arg-type]  # its stub is wrong
    except Exception as error:
        raise QuadliftError(f"no OpenGL context: {error}.", field="EGL", remedy=GL_REMEDY) from error


class Renderer:
    """Owns the OpenGL objects. Not safe to share between threads."""

    def __init__(self) -> None:
        self.context = open_context()
        ctx = self.context
        self._solid = ctx.program(vertex_shader=shaders.SOLID_VERTEX, fragment_shader=shaders.SOLID_FRAGMENT)
        self._sky = ctx.program(vertex_shader=shaders.SKY_VERTEX, fragment_shader=shaders.SKY_FRAGMENT)
        self._contact = ctx.program(vertex_shader=shaders.CONTACT_VERTEX, fragment_shader=shaders.CONTACT_FRAGMENT)
        self._depth = ctx.program(vertex_shader=shaders.DEPTH_VERTEX, fragment_shader=shaders.DEPTH_FRAGMENT)
        self._mask = ctx.program(vertex_shader=shaders.DEPTH_VERTEX, fragment_shader=shaders.MASK_FRAGMENT)
        self._frames: dict[tuple[int, int], tuple[moderngl.Framebuffer, moderngl.Framebuffer]] = {}
        self._shadow_map = ctx.depth_texture((_SHADOW_PX, _SHADOW_PX))
        self._shadow_map.compare_func = "<="
        self._shadow_map.repeat_x = self._shadow_map.repeat_y = False
        self._shadow_frame = ctx.framebuffer(depth_attachment=self._shadow_map)
        self._sky_array = ctx.vertex_array(self._sky, [])
        self._corners = ctx.buffer(np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], "f4"))
        self._lamps = LampPainter(ctx, self._corners)
        self._scene: Drawable | None = None
        self._actors: dict[int, Drawable] = {}
        self._noise: moderngl.Texture | None = None
        self._shadow_from_world = np.eye(4)

    def set_scene(self, static: Mesh, seed: int) -> None:
        """Start a new scene: its unmoving mesh, and the seed of its grain."""
        for old in (self._scene, *self._actors.values(), self._noise):
            if old is not None:
                old.release()
        self._actors = {}
        self._scene = self._drawable(static)
        self._noise = noise_texture(self.context, seed)

    def keep_actors(self, meshes: dict[int, Mesh]) -> None:
        """Make these the known road users, by id; meshes already known stay as they are."""
        for known in list(self._actors):
            if known not in meshes:
                self._actors.pop(known).release()
        for key, mesh in meshes.items():
            if key not in self._actors:
                self._actors[key] = self._drawable(mesh)

    def cast_light(self, light: Light, cast: Cast) -> None:
        """Draw the shadow map for the sun and the light map of the lamps; once an instant, before the cameras."""
        self._lamps.cast(cast.lamps)
        clip = sun_clip(light.sun_direction, _SHADOW_REACH_M)
        self._shadow_from_world = _BIAS @ clip
        self._shadow_frame.use()
        self._shadow_frame.clear(depth=1.0)
        if light.sun.max() < 0.05:
            return
        ctx = self.context
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.polygon_offset = 2.0, 4.0
        set_values(self._depth, clip_from_world=clip)
        self._draw(self._depth, "depth", cast.placed)
        ctx.polygon_offset = 0.0, 0.0

    def shoot(self, camera: Camera, light: Light, film: Film, cast: Cast) -> Shot:
        """One camera's view, without lens distortion."""
        ctx = self.context
        assert self._noise is not None
        size = (camera.width, camera.height)
        frame, picture = self._frames_of(size)
        clip = clip_from_cam(camera) @ camera.T_cam_world
        frame.use()
        frame.clear(depth=1.0)
        self._noise.use(0)
        self._shadow_map.use(1)
        self._lamps.light_map.use(2)
        exposed = _exposed(film, size)
        air = {name: getattr(light, name) for name in ("zenith", "horizon", "bounce", "sun", "sun_direction")}
        eye, axis = camera.position_m, camera.R_cam_world[2]
        set_values(self._solid, clip_from_world=clip, shadow_from_world=self._shadow_from_world, eye=eye, axis=axis, **air)
        set_values(self._solid, haze=light.haze_per_m, wet=light.wet, window_light=0.22 if light.dark else 0.0, **exposed)
        set_values(self._solid, noise=0, shadow_map=1, lamp_map=2, lamp_scale=self._lamps.scale)
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        ctx.front_face = "cw"
        seen = in_view(camera, cast.boxes)
        shown = {key: cast.placed[key] for key, visible in zip(cast.ids, seen, strict=True) if visible}
        self._draw(self._solid, "solid", shown, {key: k + 1 for k, key in enumerate(cast.ids)})
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = "<="
        world_from_clip = np.asarray(np.linalg.inv(clip), dtype=np.float64)
        set_values(self._sky, world_from_clip=world_from_clip, eye=eye, noise=0, cloudiness=light.cloudiness, **air, **exposed)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)
        ctx.depth_func = "<"
        # Integer attachments must not be touched by blended drawing.
        picture.use()
        self._draw_contacts(clip, eye, light.haze_per_m, cast.boxes[seen])
        self._lamps.shine(cast.lamps, clip, eye, light.haze_per_m, size, float(camera.K[0, 0]), light.wet, exposed)
        return _read(frame, size)

    def silhouettes(self, camera: Camera, xyxy_px: Array, ids: list[int], placed: dict[int, Array]) -> NDArray[np.uint8]:
        """Each road user alone, its pixel rectangle (N, 4) spread over a tile: masks (N, h, w), 255 inside."""
        ctx = self.context
        across, down = _TILES_ACROSS, -(-max(len(ids), 1) // _TILES_ACROSS)
        w, h = TILE_PX
        target = ctx.texture((across * w, down * h), 1)
        frame = ctx.framebuffer([target])
        frame.use()
        frame.clear()
        ctx.enable_only(moderngl.NOTHING)
        clip = crop_clip(camera, xyxy_px) @ clip_from_cam(camera) @ camera.T_cam_world
        for k, key in enumerate(ids):
            frame.viewport = (k % across * w, k // across * h, w, h)
            set_values(self._mask, clip_from_world=clip[k], world_from_model=placed[key])
            self._actors[key].arrays["mask"].render()
        masks = np.frombuffer(frame.read(components=1, alignment=1, viewport=(0, 0, across * w, down * h)), np.uint8)
        frame.release()
        target.release()
        tiles = masks.reshape(down, h, across, w).swapaxes(1, 2).reshape(-1, h, w)
        return tiles[: len(ids)]

    def release(self) -> None:
        """Free the context and everything in it."""
        self.context.release()

    def _drawable(self, mesh: Mesh) -> Drawable:
        return Drawable(self.context, self._solid, self._depth, self._mask, mesh)

    def _frames_of(self, size: tuple[int, int]) -> tuple[moderngl.Framebuffer, moderngl.Framebuffer]:
        """What is drawn into for a picture size: with truth, and the picture alone."""
        if size not in self._frames:
            ctx = self.context
            color, truth = ctx.texture(size, 4), ctx.texture(size, 2, dtype="u2")
            depth = ctx.depth_renderbuffer(size)
            picture = ctx.framebuffer([color], depth)
            # Blended things lie over one another; none may hide the next.
            picture.depth_mask = False
            self._frames[size] = (ctx.framebuffer([color, truth], depth), picture)
        return self._frames[size]

    def _draw(
        self, program: moderngl.Program, kind: str, placed: dict[int, Array], numbers: dict[int, int] | None = None
    ) -> None:
        """Road users first: they hide much of the ground, which then need not be shaded."""
        assert self._scene is not None
        for key, matrix in placed.items():
            set_values(program, world_from_model=matrix)
            if numbers is not None:
                set_values(program, instance=numbers[key])
            self._actors[key].arrays[kind].render()
        set_values(program, world_from_model=np.eye(4))
        if numbers is not None:
            set_values(program, instance=0)
        self._scene.arrays[kind].render()

    def _draw_contacts(self, clip: Array, eye: Array, haze: float, boxes: Array) -> None:
        if not len(boxes):
            return
        ctx = self.context
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        rows = np.column_stack([boxes[:, :2], np.sin(boxes[:, 2]), np.cos(boxes[:, 2]), boxes[:, 3:6]]).astype("f4")
        buffer = ctx.buffer(np.ascontiguousarray(rows))
        set_values(self._contact, clip_from_world=clip, eye=eye, haze=haze)
        array = ctx.vertex_array(
            self._contact, [(self._corners, "2f4", "in_corner"), (buffer, "4f4 3f4/i", "in_place", "in_size")]
        )
        array.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(boxes))
        array.release()
        buffer.release()


def _exposed(film: Film, size: tuple[int, int]) -> dict[str, tuple[float, ...]]:
    """Uniforms of the film for a picture size."""
    diagonal = float(np.hypot(*size)) / 2
    lens = (1 / diagonal, 1 / diagonal, -0.5 * size[0] / diagonal, -0.5 * size[1] / diagonal)
    return {"gain": tuple(float(g) for g in film.gain), "lens": lens, "grade": (film.vignetting, film.saturation)}


def _read(frame: moderngl.Framebuffer, size: tuple[int, int]) -> Shot:
    width, height = size
    image = np.frombuffer(frame.read(components=3, alignment=1), np.uint8).reshape(height, width, 3)
    truth = np.frombuffer(frame.read(components=2, attachment=1, dtype="u2", alignment=1), np.uint16)
    truth = truth.reshape(height, width, 2)
    return Shot(image, truth[..., 0], truth[..., 1])
