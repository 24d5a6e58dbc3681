"""Lamps of a dark scene: the light that they throw on the ground, their halos, their reflections in a wet road."""

from __future__ import annotations

from dataclasses import dataclass

import moderngl
import numpy as np

from models_export.scenes import shaders
from models_export.scenes.drawable import set_values
from models_export.scenes.mesh import Array

REACH_M = 80.0
"""The light map covers this far from the origin along both axes."""
_MAP_PX = 512
_STREET, _BEAM = 0.0, 1.0


@dataclass(frozen=True, eq=False)
class Lamps:
    """All lamps that are on at one instant."""

    place: Array
    """(N, 3) world, metres."""
    rgb: Array
    """(N, 3) linear brightness of the halo."""
    size: Array
    """(N,) radius of the halo, metres."""
    facing: Array
    """(N, 3) unit direction of head and tail lamps; zero for lamps that shine all round."""
    pools: Array
    """(M, 8) light on the ground: x, y, height, heading, then red, green, blue, and 0 for a disc or 1 for a beam ahead."""

    @classmethod
    def none(cls) -> Lamps:
        """No lamps."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 8)))


def street_pools(heads: Array, rgb: Array) -> Array:
    """Pools (M, 8) of lamps with heads (M, 3) that light (3,) the ground right below them."""
    colors = np.broadcast_to(rgb, (len(heads), 3))
    return np.column_stack([heads, np.zeros(len(heads)), colors, np.full(len(heads), _STREET)])


def beam_pools(poses: Array, lengths: Array, rgb: Array) -> Array:
    """Pools (M, 8) of the head lamps of vehicles with poses x, y, yaw (M, 3) and lengths (M,)."""
    nose = poses[:, :2] + 0.5 * lengths[:, None] * np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2])], 1)
    colors = np.broadcast_to(rgb, (len(poses), 3))
    return np.column_stack([nose, np.full(len(poses), 0.7), poses[:, 2], colors, np.full(len(poses), _BEAM)])


class LampPainter:
    """Owns the OpenGL objects that draw lamps."""

    def __init__(self, context: moderngl.Context, corners: moderngl.Buffer) -> None:
        self._context, self._corners = context, corners
        self._pool = context.program(vertex_shader=shaders.LAMP_VERTEX, fragment_shader=shaders.LAMP_FRAGMENT)
        self._glow = context.program(vertex_shader=shaders.GLOW_VERTEX, fragment_shader=shaders.GLOW_FRAGMENT)
        self._mirror = context.program(vertex_shader=shaders.MIRROR_VERTEX, fragment_shader=shaders.MIRROR_FRAGMENT)
        self.light_map = context.texture((_MAP_PX, _MAP_PX), 4, dtype="f2")
        self.light_map.repeat_x = self.light_map.repeat_y = False
        self._frame = context.framebuffer([self.light_map])
        self._lit = True

    @property
    def scale(self) -> float:
        """From metres to the light map's 0..1, without its middle."""
        return 0.5 / REACH_M

    def cast(self, lamps: Lamps) -> None:
        """Draw the light map."""
        if not len(lamps.pools) and not self._lit:
            return
        self._frame.use()
        self._frame.clear()
        self._lit = bool(len(lamps.pools))
        if not self._lit:
            return
        ctx = self._context
        ctx.enable_only(moderngl.BLEND)
        ctx.blend_func = moderngl.ONE, moderngl.ONE
        set_values(self._pool, scale=self.scale)
        self._instances(self._pool, lamps.pools, "4f4 4f4/i", ("in_place", "in_light"))

    def shine(
        self,
        lamps: Lamps,
        clip: Array,
        eye: Array,
        haze: float,
        size: tuple[int, int],
        focal_px: float,
        wet: float,
        film: dict[str, tuple[float, ...]],
    ) -> None:
        """Add halos and, on a wet road, reflections to the picture in use. ``film``: uniforms of the film."""
        if not len(lamps.place):
            return
        ctx = self._context
        ctx.enable_only(moderngl.DEPTH_TEST | moderngl.BLEND)
        ctx.blend_func = moderngl.ONE, moderngl.ONE
        # Halos are drawn for a lens of 1000 px; a longer one shows them larger.
        radius = lamps.size * focal_px / 1000.0
        turned = np.any(lamps.facing, axis=1).astype(np.float64)
        rows = np.column_stack([lamps.place, radius, lamps.rgb, np.zeros(len(radius)), lamps.facing, turned])
        # Fog swallows less of a lamp's halo than of a surface: what it scatters stays near the line of sight.
        set_values(self._glow, clip_from_world=clip, eye=eye, haze=0.4 * haze, px=(2.0 / size[0], 2.0 / size[1]), **film)
        names = ("in_place", "in_light", "in_facing")
        if wet > 0:
            set_values(self._mirror, clip_from_world=clip, eye=eye, haze=haze, **film)
            mirrored = rows.copy()
            mirrored[:, 4:7] *= wet
            self._instances(self._mirror, mirrored, "4f4 4f4 4f4/i", names)
        self._instances(self._glow, rows, "4f4 4f4 4f4/i", names)

    def _instances(self, program: moderngl.Program, rows: Array, layout: str, names: tuple[str, ...]) -> None:
        buffer = self._context.buffer(np.ascontiguousarray(rows, dtype="f4"))
        array = self._context.vertex_array(program, [(self._corners, "2f4", "in_corner"), (buffer, layout, *names)])
        array.render(moderngl.TRIANGLE_STRIP, vertices=4, instances=len(rows))
        array.release()
        buffer.release()
