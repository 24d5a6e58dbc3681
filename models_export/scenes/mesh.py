"""Triangle meshes with colour and surface per face: what every solid thing of a scene is made of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

VERTEX_FORMAT = "3f4 3f4 4f1 4f1"
VERTEX_ATTRIBUTES = ("in_position", "in_normal", "in_color", "in_surface")
_VERTEX_DTYPE = np.dtype([("position", "<f4", 3), ("normal", "<f4", 3), ("color", "u1", 4), ("surface", "u1", 4)])
_WELD_M = 1e-4
_HASH = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9, 0x27D4EB2F165667C5], dtype=np.uint64)
"""Odd multipliers, one for each eight bytes of a vertex: equal sums mean equal vertices, but for one chance in 2^64 a pair."""


@dataclass(frozen=True)
class Surface:
    """How a face looks: colour and what the shader does with it; all values in 0..1."""

    rgb: tuple[float, float, float]
    """Display-referred (gamma) colour."""
    gloss: float = 0.0
    """Strength of the mirrored sky."""
    fine: float = 0.0
    """Contrast of fine grain (asphalt, concrete, leaves)."""
    coarse: float = 0.0
    """Contrast of stains and patches some metres wide."""
    glow: float = 0.0
    """Own light, as a fraction of display white."""
    glass: float = 0.0
    """1 for panes: they mirror the sky more and show little of their own colour."""

    def tinted(self, factor: float) -> Surface:
        """The same surface, brighter or darker."""
        r, g, b = (min(1.0, max(0.0, c * factor)) for c in self.rgb)
        return replace(self, rgb=(r, g, b))


@dataclass(frozen=True, eq=False)
class Mesh:
    """F triangles: ``corners`` and ``normals`` (F, 3, 3), counter-clockwise from outside, metres; ``looks`` (F, 8) uint8."""

    corners: Array
    normals: Array
    looks: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.corners)

    def extents(self) -> tuple[Array, Array]:
        """Lowest and highest coordinates, (3,) each, metres."""
        points = self.corners.reshape(-1, 3)
        return points.min(0), points.max(0)

    def moved(self, R: ArrayLike, t: ArrayLike) -> Mesh:
        """The mesh rotated by R (3, 3), then shifted by t (3,)."""
        R = np.asarray(R, dtype=np.float64)
        return Mesh(self.corners @ R.T + np.asarray(t, dtype=np.float64), self.normals @ R.T, self.looks)

    def fitted(self, dims: ArrayLike) -> Mesh:
        """The mesh stretched so that its extents are exactly ``dims`` (3,), centred on the origin."""
        low, high = self.extents()
        scale = np.asarray(dims, dtype=np.float64) / (high - low)
        normals = self.normals / scale
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        return Mesh((self.corners - 0.5 * (low + high)) * scale, normals, self.looks)

    def buffers(self) -> tuple[bytes, bytes]:
        """Vertices in ``VERTEX_FORMAT`` and uint32 indices, identical vertices shared."""
        vertices = np.empty(3 * len(self), _VERTEX_DTYPE)
        vertices["position"] = self.corners.reshape(-1, 3)
        vertices["normal"] = self.normals.reshape(-1, 3)
        looks = np.repeat(self.looks, 3, axis=0)
        vertices["color"], vertices["surface"] = looks[:, :4], looks[:, 4:]
        # Sorting one number a vertex is several times faster than sorting the vertices' bytes.
        words = vertices.view(np.uint64).reshape(len(vertices), -1)
        _, first, index = np.unique((words * _HASH).sum(1), return_index=True, return_inverse=True)
        return vertices[first].tobytes(), index.astype("<u4").tobytes()


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes as one; at least one."""
    return Mesh(
        np.concatenate([m.corners for m in meshes]),
        np.concatenate([m.normals for m in meshes]),
        np.concatenate([m.looks for m in meshes]),
    )


class MeshBuilder:
    """Collects faces; ``build`` turns them into a mesh, rounding edges flatter than a crease angle."""

    def __init__(self) -> None:
        self._quads: list[Array] = []
        self._looks: list[NDArray[np.uint8]] = []

    def quads(self, corners: ArrayLike, surface: Surface) -> None:
        """Add quadrilaterals (N, 4, 3), counter-clockwise seen from outside; a repeated corner makes a triangle."""
        quads = np.asarray(corners, dtype=np.float64).reshape(-1, 4, 3)
        values = (*surface.rgb, surface.gloss, surface.fine, surface.coarse, surface.glow, surface.glass)
        look = np.round(255 * np.clip(values, 0, 1)).astype(np.uint8)
        self._quads.append(quads)
        self._looks.append(np.broadcast_to(look, (len(quads), 8)))

    def box(self, low: ArrayLike, high: ArrayLike, surface: Surface, *, top: Surface | None = None) -> None:
        """Add an axis-aligned box between two corners (3,), without its bottom."""
        x0, y0, z0 = np.asarray(low, dtype=np.float64)
        x1, y1, z1 = np.asarray(high, dtype=np.float64)
        self.prism(np.array([[x0, y0], [x1, y0], [x1, y1], [x0, y1]]), z0, z1, surface, top=top)

    def prism(self, outline: ArrayLike, z0: float, z1: float, surface: Surface, *, top: Surface | None = None) -> None:
        """Add a vertical prism over a convex outline (N, 2), counter-clockwise, without its bottom."""
        ring = np.asarray(outline, dtype=np.float64)
        low = np.column_stack([ring, np.full(len(ring), z0)])
        high = np.column_stack([ring, np.full(len(ring), z1)])
        self.strip(low, high, surface, closed=True)
        self.fan(high, top or surface)

    def strip(self, first: ArrayLike, second: ArrayLike, surface: Surface, *, closed: bool = False) -> None:
        """Add the band between two polylines (N, 3); it faces away from the left of the first when the second is above."""
        a, b = np.asarray(first, dtype=np.float64), np.asarray(second, dtype=np.float64)
        if closed:
            a, b = np.concatenate([a, a[:1]]), np.concatenate([b, b[:1]])
        self.quads(np.stack([a[:-1], a[1:], b[1:], b[:-1]], 1), surface)

    def fan(self, ring: ArrayLike, surface: Surface) -> None:
        """Add a convex polygon (N, 3), counter-clockwise."""
        ring = np.asarray(ring, dtype=np.float64)
        first = np.broadcast_to(ring[0], (len(ring) - 2, 3))
        self.quads(np.stack([first, ring[1:-1], ring[2:], ring[2:]], 1), surface)

    def build(self, crease_rad: float = 0.6) -> Mesh:
        """The mesh of all faces so far."""
        quads = np.concatenate(self._quads)
        looks = np.concatenate(self._looks)
        triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
        looks = np.concatenate([looks, looks])
        cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
        area = np.linalg.norm(cross, axis=1)
        solid = area > 1e-9
        triangles, looks, cross, area = triangles[solid], looks[solid], cross[solid], area[solid]
        faces = cross / area[:, None]
        normals = crease_normals(triangles, faces, area, crease_rad) if crease_rad > 0 else np.repeat(faces[:, None], 3, 1)
        return Mesh(triangles, normals, looks)


def crease_normals(triangles: Array, faces: Array, area: Array, crease_rad: float) -> Array:
    """Vertex normals (F, 3, 3): area-weighted means over the faces at a vertex that bend less than the crease angle."""
    cells = np.round(triangles.reshape(-1, 3) / _WELD_M).astype(np.int64).astype(np.uint64)
    keys = (cells * _HASH[:3]).sum(1)
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.concatenate([[True], np.diff(keys[order]) != 0]))
    counts = np.diff(np.append(starts, len(keys)))
    # All pairs (corner, other corner at the same vertex), by repeating each corner once per member of its group.
    size = np.repeat(counts, counts)
    left = np.repeat(order, size)
    step = np.arange(len(left)) - np.repeat(np.cumsum(size) - size, size)
    right = order[np.repeat(np.repeat(starts, counts), size) + step]
    near = np.einsum("ij,ij->i", faces[left // 3], faces[right // 3]) > np.cos(crease_rad)
    left, right = left[near], right[near]
    weighted = faces[right // 3] * area[right // 3, None]
    columns = [np.bincount(left, weighted[:, k], minlength=len(keys)) for k in range(3)]
    normals = np.stack(columns, -1).astype(np.float64)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return normals.reshape(-1, 3, 3)
