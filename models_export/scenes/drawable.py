"""Meshes, textures and uniforms on the graphics side: the small change of OpenGL."""

from __future__ import annotations

import moderngl
import numpy as np
from numpy.typing import NDArray

from models_export.scenes.mesh import VERTEX_ATTRIBUTES, VERTEX_FORMAT, Array, Mesh


class Drawable:
    """A mesh in buffers, with one vertex array per program that draws it."""

    def __init__(
        self, context: moderngl.Context, solid: moderngl.Program, depth: moderngl.Program, mask: moderngl.Program, mesh: Mesh
    ) -> None:
        vertices, indices = mesh.buffers()
        self._buffers = (context.buffer(vertices), context.buffer(indices))
        shape = [(self._buffers[0], "3f4 20x", "in_position")]
        self.arrays = {
            "solid": context.vertex_array(solid, [(self._buffers[0], VERTEX_FORMAT, *VERTEX_ATTRIBUTES)], self._buffers[1]),
            "depth": context.vertex_array(depth, shape, self._buffers[1]),
            "mask": context.vertex_array(mask, shape, self._buffers[1]),
        }

    def release(self) -> None:
        """Free the buffers."""
        for array in self.arrays.values():
            array.release()
        for buffer in self._buffers:
            buffer.release()


def set_values(program: moderngl.Program, **values: float | tuple[float, ...] | Array) -> None:
    """Set uniforms: numbers, tuples, or arrays (3,) and (4, 4). OpenGL wants matrices as float32, column by column."""
    for name, value in values.items():
        member = program[name]
        assert isinstance(member, moderngl.Uniform)
        if isinstance(value, np.ndarray):
            member.write(np.ascontiguousarray(value.T, dtype="f4").tobytes())
        else:
            member.value = value


def noise_texture(context: moderngl.Context, seed: int) -> moderngl.Texture:
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
