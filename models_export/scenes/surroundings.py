"""What stands beside the road: buildings, trees, street lamps, and the poles of the cameras."""

from __future__ import annotations

import numpy as np

from models_export.scenes.layout import Plot, RoadWorld, offset
from models_export.scenes.mesh import Array, MeshBuilder, Surface
from models_export.scenes.pavement import KERB_M

_WALLS = (
    (0.62, 0.44, 0.36),
    (0.72, 0.66, 0.56),
    (0.55, 0.56, 0.58),
    (0.80, 0.78, 0.74),
    (0.48, 0.36, 0.30),
    (0.66, 0.60, 0.50),
)
_BASE_M = KERB_M


def furnish(world: RoadWorld, rng: np.random.Generator) -> Array:
    """Add buildings, trees and posts to a world's ground; gives the heads of its lamps (N, 3)."""
    for foot, _ in world.poles if not world.indoor else ():
        # Behind the camera, so that the pole is not in its own picture.
        _post(world.ground, foot + 0.35 * foot / np.linalg.norm(foot), 4.8)
    if world.ceiling_lamps is not None:
        return world.ceiling_lamps
    built, lit = rng.uniform(0.35, 0.9), float(rng.uniform(0.05, 0.5))
    for plot in world.plots:
        if rng.random() < built:
            _building(world.ground, plot, lit, rng)
        else:
            for _ in range(int(rng.integers(0, 4))):
                x, y = (rng.uniform(lo, hi) for lo, hi in zip(plot.low, plot.high, strict=True))
                _tree(world.ground, x, y, rng)
    _row(world, rng)
    _clutter(world, rng)
    _skyline(world.ground, rng)
    return _street_lamps(world, rng)


def _street_lamps(world: RoadWorld, rng: np.random.Generator) -> Array:
    """Lamp posts along the kerbs, their arms over the road."""
    gap, height, arm = rng.uniform(22, 36), float(rng.uniform(6.5, 10.0)), float(rng.uniform(1.0, 2.2))
    feet = np.array([foot for foot, _ in world.poles])
    heads: list[Array] = []
    for line in world.kerbs:
        steps = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
        post, head = offset(line, 0.45), offset(line, -arm)
        for place in np.arange(rng.uniform(0, gap), steps[-1], gap):
            foot, tip = (np.array([np.interp(place, steps, ends[:, k]) for k in range(2)]) for ends in (post, head))
            # At corners lines meet: a lamp there serves both roads.
            crowded = any(np.hypot(*(tip - other[:2])) < 14.0 for other in heads)
            if np.abs(foot).max() < 75 and np.linalg.norm(feet - foot, axis=1).min() > 4.0 and not crowded:
                _lamp_post(world.ground, foot, tip, height)
                heads.append(np.array([*tip, height - 0.1]))
    return np.array(heads).reshape(-1, 3)


def _lamp_post(mesh: MeshBuilder, foot: Array, tip: Array, height: float) -> None:
    steel = Surface((0.42, 0.43, 0.44), gloss=0.2)
    _tube(mesh, foot, 0.08, 0.0, height, steel)
    along = (tip - foot) / np.linalg.norm(tip - foot)
    side = 0.05 * np.array([-along[1], along[0]])
    arm = np.array([foot + side, foot - side, tip - side, tip + side])
    mesh.prism(arm[::-1] if _turns_right(arm) else arm, height - 0.06, height + 0.02, steel)
    head = np.array([tip - 0.5 * along + 2.4 * side, tip - 0.5 * along - 2.4 * side, tip - 2.4 * side, tip + 2.4 * side])
    head = head[::-1] if _turns_right(head) else head
    mesh.prism(head, height - 0.05, height + 0.06, steel)
    pane = np.column_stack([head[::-1], np.full(4, height - 0.06)])
    mesh.quads(pane, Surface((0.9, 0.9, 0.85), glow=1.0, glass=1.0))


def _turns_right(ring: Array) -> bool:
    (x0, y0), (x1, y1), (x2, y2) = ring[:3]
    return bool((x1 - x0) * (y2 - y1) - (y1 - y0) * (x2 - x1) < 0)


def _skyline(mesh: MeshBuilder, rng: np.random.Generator) -> None:
    """A ring of woods and far houses where the roads end."""
    angle = np.linspace(0, 2 * np.pi, 73)[:-1]
    radius, height = 142.0, np.convolve(rng.uniform(3, 13, 74), [0.3, 0.4, 0.3], "valid")
    ring = radius * np.stack([np.cos(angle), np.sin(angle)], 1)
    low, high = np.column_stack([ring, np.zeros(72)]), np.column_stack([ring, height])
    following = np.roll(np.arange(72), -1)
    for k in range(72):
        wood = (
            Surface((0.22, 0.27, 0.17), fine=0.5, coarse=0.5) if rng.random() < 0.7 else Surface((0.5, 0.48, 0.46), coarse=0.3)
        )
        n = following[k]
        mesh.quads([low[n], low[k], high[k], high[n]], wood.tinted(float(rng.uniform(0.8, 1.2))))


def _clutter(world: RoadWorld, rng: np.random.Generator) -> None:
    """Things that are not vehicles: bins, cabinets, hedges, signs."""
    for plot in world.plots:
        low, high = np.array(plot.low), np.array(plot.high)
        if np.abs(np.clip(np.zeros(2), low, high)).max() > 60:
            continue
        for _ in range(int(rng.integers(0, 4))):
            nearest = np.clip(np.zeros(2), low, high)
            axis = int(rng.integers(2))
            spot = nearest + 0.0
            spot[axis] = rng.uniform(low[axis], high[axis])
            spot[1 - axis] -= rng.uniform(0.6, 3.6) * np.sign(spot[1 - axis])
            if _beside_road(world, spot):
                _thing(world.ground, spot, rng)


def _thing(mesh: MeshBuilder, spot: Array, rng: np.random.Generator) -> None:
    kind = rng.random()
    shade = Surface(tuple(rng.uniform(0.15, 0.7, 3).tolist()), fine=0.1)
    if kind < 0.25:
        _body(mesh, spot, (rng.uniform(0.4, 1.2), rng.uniform(0.4, 0.8), rng.uniform(0.7, 1.4)), shade)
    elif kind < 0.45:
        hedge = Surface((0.18, 0.27, 0.12), fine=0.9, coarse=0.3).tinted(float(rng.uniform(0.8, 1.2)))
        _body(mesh, spot, (rng.uniform(0.8, 4.0), rng.uniform(0.8, 1.4), rng.uniform(0.6, 1.3)), hedge)
    else:
        _post(mesh, spot, 2.6)
        plate = Surface(((0.7, 0.1, 0.1), (0.1, 0.25, 0.6), (0.85, 0.85, 0.8))[rng.integers(3)], gloss=0.2)
        mesh.box([spot[0] - 0.3, spot[1] - 0.3, 2.0], [spot[0] + 0.3, spot[1] - 0.22, 2.7], plate)
        mesh.box([spot[0] - 0.3, spot[1] + 0.22, 2.0], [spot[0] + 0.3, spot[1] + 0.3, 2.7], plate)


def _body(mesh: MeshBuilder, spot: Array, size: tuple[float, float, float], surface: Surface) -> None:
    half = 0.5 * np.array(size[:2])
    mesh.box([*(spot - half), _BASE_M], [*(spot + half), _BASE_M + size[2]], surface)


def _row(world: RoadWorld, rng: np.random.Generator) -> None:
    """Street trees and plain posts between sidewalk and plots, away from the cameras."""
    trees = rng.random() < 0.6
    feet = np.array([foot for foot, _ in world.poles])
    for plot in world.plots:
        low, high = np.array(plot.low), np.array(plot.high)
        nearest = np.clip(np.zeros(2), low, high)
        for axis in range(2):
            spot = nearest + 0.0
            spot[axis] = rng.uniform(low[axis], high[axis])
            spot[1 - axis] -= 1.3 * np.sign(spot[1 - axis])
            if np.linalg.norm(feet - spot, axis=1).min() < 8.0 or not _beside_road(world, spot):
                continue
            if trees and rng.random() < 0.35:
                _tree(world.ground, spot[0], spot[1], rng, small=True)
            elif rng.random() < 0.25:
                _post(world.ground, spot, float(rng.uniform(6, 9)))


def _beside_road(world: RoadWorld, spot: Array) -> bool:
    """Whether a spot is well clear of every route."""
    return world.clear_of_routes(spot) > 2.6


def _building(mesh: MeshBuilder, plot: Plot, lit: float, rng: np.random.Generator) -> None:
    """A block of two to six floors; ``lit`` is the share of windows with light behind them."""
    low, high = np.array(plot.low), np.array(plot.high)
    low, high = low + rng.uniform(0, 1.5, 2), high - rng.uniform(0, 2.5, 2)
    floors = int(rng.integers(2, 7))
    storey = rng.uniform(2.9, 3.5)
    height = _BASE_M + floors * storey + 0.8
    wall = Surface(_WALLS[rng.integers(len(_WALLS))], fine=0.12, coarse=0.2).tinted(float(rng.uniform(0.7, 1.15)))
    roof = Surface((0.34, 0.33, 0.33), fine=0.2)
    mesh.box([*low, _BASE_M], [*high, height], wall, top=roof)
    mesh.box([*(low - 0.12), height - 0.45], [*(high + 0.12), height], wall.tinted(0.85), top=roof)
    if rng.random() < 0.4:
        plinth = Surface((0.5, 0.49, 0.47), fine=0.2).tinted(float(rng.uniform(0.6, 1.1)))
        mesh.box([*(low - 0.03), _BASE_M], [*(high + 0.03), _BASE_M + storey], plinth)
    pitch, wide, tall = rng.uniform(2.2, 3.6), rng.uniform(1.0, 1.7), rng.uniform(1.2, 1.9)
    if rng.random() < 0.25:
        wide = pitch
    shop = rng.random() < 0.4
    for side in range(4):
        _windows(mesh, low, high, side, floors, storey, pitch, (wide, tall), shop, lit, rng)


def _windows(
    mesh: MeshBuilder,
    low: Array,
    high: Array,
    side: int,
    floors: int,
    storey: float,
    pitch: float,
    size: tuple[float, float],
    shop: bool,
    lit: float,
    rng: np.random.Generator,
) -> None:
    """Panes on one wall, a few centimetres proud of it; some lit or curtained."""
    axis, outward = side % 2, 1 if side < 2 else -1
    # Walls that face away from the road are never seen.
    plane = high[axis] if outward > 0 else low[axis]
    if outward * np.sign(plane) > 0:
        return
    start, stop = low[1 - axis], high[1 - axis]
    count = max(1, int((stop - start - 0.8) / pitch))
    offset = 0.5 * (stop - start - (count - 1) * pitch)
    for floor in range(floors):
        full = shop and floor == 0
        width, height = (pitch * 0.9, storey * 0.75) if full else size
        z = _BASE_M + floor * storey + (0.35 if full else 0.9)
        for k in range(count):
            middle = start + offset + k * pitch
            shade = rng.uniform(0.05, 0.2) if rng.random() < 0.75 else rng.uniform(0.3, 0.55)
            glow = float(rng.uniform(0.1, 0.8)) if rng.random() < (0.8 if full else lit) else 0.0
            pane = Surface((shade, shade * 1.03, shade * 1.08), gloss=0.9, glow=glow, glass=1.0)
            place = plane + 0.04 * outward
            a, b = (middle - width / 2, middle + width / 2)
            if (axis == 0) != (outward > 0):
                a, b = b, a
            corners = np.zeros((4, 3))
            corners[:, axis] = place
            corners[:, 1 - axis] = (a, b, b, a)
            corners[:, 2] = (z, z, z + height, z + height)
            mesh.quads(corners, pane)


def _tree(mesh: MeshBuilder, x: float, y: float, rng: np.random.Generator, *, small: bool = False) -> None:
    height = rng.uniform(4.0, 6.5) if small else rng.uniform(5.0, 11.0)
    trunk = 0.30 * height
    bark = Surface((0.30, 0.24, 0.18), fine=0.3)
    _tube(mesh, np.array([x, y]), 0.11 if small else 0.2, _BASE_M, trunk + 0.3 * height, bark)
    green = Surface((rng.uniform(0.14, 0.30), rng.uniform(0.26, 0.38), rng.uniform(0.08, 0.16)), fine=0.9, coarse=0.3)
    radius = 0.24 * height
    for _ in range(int(rng.integers(5, 9))):
        middle = np.array([x, y, 0.68 * height]) + rng.normal(0, 1, 3) * np.array([0.5, 0.5, 0.45]) * radius
        _blob(mesh, middle, radius * rng.uniform(0.4, 0.8), green.tinted(float(rng.uniform(0.7, 1.25))), rng)


def _blob(mesh: MeshBuilder, center: Array, radius: float, surface: Surface, rng: np.random.Generator) -> None:
    """A lumpy ball of leaves."""
    rows, columns = 6, 9
    theta = np.linspace(0, np.pi, rows)[:, None]
    phi = np.linspace(0, 2 * np.pi, columns + 1)[None, :]
    r = radius * (1 + rng.uniform(-0.22, 0.22, (rows, columns + 1)))
    r[:, -1] = r[:, 0]
    r[[0, -1]] = radius
    grid = center + r[..., None] * np.stack(
        np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), -1
    )
    mesh.quads(np.stack([grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:], grid[:-1, :-1]], 2).reshape(-1, 4, 3), surface)


def _post(mesh: MeshBuilder, foot: Array, height: float) -> None:
    _tube(mesh, foot, 0.09, 0.0, height, Surface((0.45, 0.46, 0.47), gloss=0.2))


def _tube(mesh: MeshBuilder, foot: Array, radius: float, z0: float, z1: float, surface: Surface) -> None:
    angle = np.linspace(0, 2 * np.pi, 9)[:-1]
    mesh.prism(foot + radius * np.stack([np.cos(angle), np.sin(angle)], 1), z0, z1, surface)
