"""Draws a scene with OpenGL: pictures, depth and instance numbers in one pass, silhouettes in a second.

Rows come out top first: the projection turns the picture upside down for OpenGL, so that nothing has to be flipped later.
"""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np
from numpy.typing import NDArray

from models_export.scenes import shaders
from models_export.scenes.light import Film, Light
from models_export.scenes.mesh import VERTEX_ATTRIBUTES, VERTEX_FORMAT, Array, Mesh
from models_export.scenes.projection import clip_from_cam, crop_clip, sun_clip
from service.errors import QuadliftError
from service.geometry.camera import Camera

TILE_PX = (128, 64)
"""Width and height of a silhouette's tile."""
_TILES_ACROSS = 8
_SHADOW_PX = 2048
_SHADOW_REACH_M = 62.0
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
    """(H, W): 0, or 1 + the index of the vehicle seen there."""
    depth: NDArray[np.uint16]
    """(H, W): metres along the optical axis times 256, rounded; 0 for sky and beyond 255 m."""


def open_context() -> moderngl.Context:
    """A context without a window. Raises QuadliftError naming the system packages when there is no EGL or driver."""
    try:
        return moderngl.create_context(standalone=True, backend="egl", require=330)  # type: ignore[arg-type]  # its stub is wrong
    except Exception as error:
        raise QuadliftError(f"no OpenGL context: {error}.", field="EGL", remedy=GL_REMEDY) from error


class Renderer:
    """Owns the OpenGL objects. Not safe to share between threads."""

    def __init__(self, width: int, height: int) -> None:
        self.size = (width, height)
        self.context = open_context()
        ctx = self.context
        self._solid = ctx.program(vertex_shader=shaders.SOLID_VERTEX, fragment_shader=shaders.SOLID_FRAGMENT)
        self._sky = ctx.program(vertex_shader=shaders.SKY_VERTEX, fragment_shader=shaders.SKY_FRAGMENT)
        self._contact = ctx.program(vertex_shader=shaders.CONTACT_VERTEX, fragment_shader=shaders.CONTACT_FRAGMENT)
        self._depth = ctx.program(vertex_shader=shaders.DEPTH_VERTEX, fragment_shader=shaders.DEPTH_FRAGMENT)
        self._mask = ctx.program(vertex_shader=shaders.DEPTH_VERTEX, fragment_shader=shaders.MASK_FRAGMENT)
        self._color = ctx.texture(self.size, 4)
        self._truth = ctx.texture(self.size, 2, dtype="u2")
        self._frame = ctx.framebuffer([self._color, self._truth], ctx.depth_renderbuffer(self.size))
        # Only the picture: integer attachments must not be touched by blended drawing.
        self._picture = ctx.framebuffer([self._color], self._frame.depth_attachment)
        self._shadow_map = ctx.depth_texture((_SHADOW_PX, _SHADOW_PX))
        self._shadow_map.compare_func = "<="
        self._shadow_map.repeat_x = self._shadow_map.repeat_y = False
        self._shadow_frame = ctx.framebuffer(depth_attachment=self._shadow_map)
        self._sky_array = ctx.vertex_array(self._sky, [])
        self._corners = ctx.buffer(np.array([[-1, -1], [1, -1], [-1, 1], [1, 1]], "f4"))
        self._scene: Drawable | None = None
        self._vehicles: dict[int, Drawable] = {}
        self._noise: moderngl.Texture | None = None
        self._shadow_from_world = np.eye(4)

    def set_scene(self, static: Mesh, seed: int) -> None:
        """Start a new scene: its unmoving mesh, and the seed of its grain."""
        for old in (self._scene, *self._vehicles.values()):
            if old is not None:
                old.release()
        self._vehicles = {}
        self._scene = Drawable(self, static)
        if self._noise is not None:
            self._noise.release()
        self._noise = _noise_texture(self.context, seed)

    def keep_vehicles(self, meshes: dict[int, Mesh]) -> None:
        """Make these the known vehicles, by id; meshes already known stay as they are."""
        for known in list(self._vehicles):
            if known not in meshes:
                self._vehicles.pop(known).release()
        for key, mesh in meshes.items():
            if key not in self._vehicles:
                self._vehicles[key] = Drawable(self, mesh)

    def cast_shadows(self, light: Light, placed: dict[int, Array]) -> None:
        """Draw the shadow map for the sun; ``placed`` gives ``world_from_model`` (4, 4) by vehicle id."""
        ctx = self.context
        clip = sun_clip(light.sun_direction, _SHADOW_REACH_M)
        self._shadow_from_world = np.array([[0.5, 0, 0, 0.5], [0, 0.5, 0, 0.5], [0, 0, 0.5, 0.5], [0, 0, 0, 1]]) @ clip
        self._shadow_frame.use()
        self._shadow_frame.clear(depth=1.0)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.polygon_offset = 2.0, 4.0
        _set_matrix(self._depth, "clip_from_world", clip)
        self._draw(self._depth, "depth", placed)
        ctx.polygon_offset = 0.0, 0.0

    def shoot(self, camera: Camera, light: Light, film: Film, placed: dict[int, Array], order: list[int], boxes: Array) -> Shot:
        """One camera's view. ``order`` lists vehicle ids by index; ``boxes`` (N, 5) is x, y, yaw, length, width of each."""
        ctx = self.context
        assert self._noise is not None
        clip = clip_from_cam(camera) @ camera.T_cam_world
        self._frame.use()
        self._frame.clear(depth=1.0)
        self._noise.use(0)
        self._shadow_map.use(1)
        self._light(self._solid, light, film)
        _set_matrix(self._solid, "clip_from_world", clip)
        _set_matrix(self._solid, "shadow_from_world", self._shadow_from_world)
        _set(self._solid, "eye", tuple(camera.position_m))
        _set(self._solid, "axis", tuple(camera.R_cam_world[2]))
        _set(self._solid, "haze", light.haze_per_m)
        _set(self._solid, "noise", 0)
        _set(self._solid, "shadow_map", 1)
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        ctx.front_face = "cw"
        self._draw(self._solid, "solid", placed, order)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = "<="
        self._draw_sky(camera, clip, light, film)
        ctx.depth_func = "<"
        self._draw_contacts(clip, boxes)
        image = np.frombuffer(self._frame.read(components=3, alignment=1), np.uint8)
        truth = np.frombuffer(self._frame.read(components=2, attachment=1, dtype="u2", alignment=1), np.uint16)
        width, height = self.size
        truth = truth.reshape(height, width, 2)
        return Shot(image.reshape(height, width, 3), truth[..., 0], truth[..., 1])

    def silhouettes(self, camera: Camera, xyxy_px: Array, ids: list[int], placed: dict[int, Array]) -> NDArray[np.uint8]:
        """Each vehicle alone, its pixel rectangle (N, 4) spread over a tile: masks (N, h, w), 255 inside."""
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
            _set_matrix(self._mask, "clip_from_world", clip[k])
            _set_matrix(self._mask, "world_from_model", placed[key])
            self._vehicles[key].arrays["mask"].render()
        masks = np.frombuffer(frame.read(components=1, alignment=1, viewport=(0, 0, across * w, down * h)), np.uint8)
        frame.release()
        target.release()
        tiles = masks.reshape(down, h, across, w).swapaxes(1, 2).reshape(-1, h, w)
        return tiles[: len(ids)]

    def release(self) -> None:
        """Free the context and everything in it."""
        self.context.release()

    def vertex_array(self, kind: str, vertices: moderngl.Buffer, indices: moderngl.Buffer) -> moderngl.VertexArray:
        """How a mesh's buffers feed the programs: ``solid``, ``depth`` or ``mask``."""
        if kind == "solid":
            return self.context.vertex_array(self._solid, [(vertices, VERTEX_FORMAT, *VERTEX_ATTRIBUTES)], indices)
        program = {"depth": self._depth, "mask": self._mask}[kind]
        return self.context.vertex_array(program, [(vertices, "3f4 20x", "in_position")], indices)

    def _draw(self, program: moderngl.Program, kind: str, placed: dict[int, Array], order: list[int] | None = None) -> None:
        """Vehicles first: they hide much of the ground, which then need not be shaded."""
        assert self._scene is not None
        for key, matrix in placed.items():
            _set_matrix(program, "world_from_model", matrix)
            if order is not None:
                _set(program, "instance", order.index(key) + 1)
            self._vehicles[key].arrays[kind].render()
        _set_matrix(program, "world_from_model", np.eye(4))
        if order is not None:
            _set(program, "instance", 0)
        self._scene.arrays[kind].render()

    def _draw_sky(self, camera: Camera, clip: Array, light: Light, film: Film) -> None:
        self._light(self._sky, light, film)
        _set_matrix(self._sky, "world_from_clip", np.asarray(np.linalg.inv(clip), dtype=np.float64))
        _set(self._sky, "eye", tuple(camera.position_m))
        _set(self._sky, "noise", 0)
        _set(self._sky, "cloudiness", 1.0 if light.condition == "overcast" else 0.3)
        self._sky_array.render(moderngl.TRIANGLES, vertices=3)

    def _draw_contacts(self, clip: Array, boxes: Array) -> None:
        if not len(boxes):
            return
        ctx = self.context
        self._picture.use()
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        ctx.blend_func = moderngl.SRC_ALPHA, moderngl.ONE_MINUS_SRC_ALPHA
        rows = np.column_stack([boxes[:, :2], np.sin(boxes[:, 2]), np.cos(boxes[:, 2]), boxes[:, 3:5]]).astype("f4")
        buffer = ctx.buffer(np.ascontiguousarray(rows))
        _set_matrix(self._contact, "clip_from_world", clip)
        array = ctx.vertex_array(
            self._contact, [(self._corners, "2f4", "in_corner"), (buffer, "4f4 2f4/i", "in_place", "in_size")]
        )
        array.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(boxes))
        array.release()
        buffer.release()

    def _light(self, program: moderngl.Program, light: Light, film: Film) -> None:
        values = {
            "zenith": light.zenith,
            "horizon": light.horizon,
            "bounce": light.bounce,
            "sun": light.sun,
            "sun_direction": light.sun_direction,
            "gain": film.gain,
        }
        for name, value in values.items():
            if name in program:
                _set(program, name, tuple(value))


class Drawable:
    """A mesh on the graphics side."""

    def __init__(self, renderer: Renderer, mesh: Mesh) -> None:
        vertices, indices = mesh.buffers()
        self._buffers = (renderer.context.buffer(vertices), renderer.context.buffer(indices))
        self.arrays = {kind: renderer.vertex_array(kind, *self._buffers) for kind in ("solid", "depth", "mask")}

    def release(self) -> None:
        """Free the buffers."""
        for array in self.arrays.values():
            array.release()
        for buffer in self._buffers:
            buffer.release()


def _uniform(program: moderngl.Program, name: str) -> moderngl.Uniform:
    member = program[name]
    assert isinstance(member, moderngl.Uniform)
    return member


def _set(program: moderngl.Program, name: str, value: float | tuple[float, ...]) -> None:
    _uniform(program, name).value = value


def _set_matrix(program: moderngl.Program, name: str, matrix: Array) -> None:
    """OpenGL wants matrices (4, 4) as float32, column by column."""
    _uniform(program, name).write(np.ascontiguousarray(matrix.T, dtype="f4").tobytes())


def _noise_texture(context: moderngl.Context, seed: int) -> moderngl.Texture:
    """A tileable texture: red fine grain, green soft patches."""
    rng = np.random.default_rng([seed, 0x6E6F6973])
    size = 256
    layers = [_octaves(rng, size, decay) for decay in (0.35, 1.4)]
    texture = context.texture((size, size), 2, np.ascontiguousarray(np.stack(layers, -1)).tobytes())
    texture.build_mipmaps()
    texture.filter = moderngl.LINEAR_MIPMAP_LINEAR, moderngl.LINEAR
    return texture


def _octaves(rng: np.random.Generator, size: int, decay: float) -> NDArray[np.uint8]:
    """Tileable noise (size, size) whose spectrum falls with frequency to the power -decay, spread over 0..255."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size) * size, np.fft.fftfreq(size) * size))
    spectrum = np.fft.fft2(rng.normal(size=(size, size))) / np.maximum(frequency, 1.0) ** decay
    spectrum[0, 0] = 0
    field = np.fft.ifft2(spectrum).real
    return np.asarray(np.clip(127.5 + 42 * field / field.std(), 0, 255), dtype=np.uint8)
