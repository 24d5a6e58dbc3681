"""The fixed evaluation set: scenes by seed, rendered on demand, with a checksum that notices a changed generator.

Its seeds lie above ``request.FIRST_RESERVED_SEED``, where ``scenes render`` does not go: none of its worlds, rigs, vehicles and
lights can be in a training set.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from models_export.scenes.actor import ActorModel
from models_export.scenes.cameras import RIGS
from models_export.scenes.mesh import Array
from models_export.scenes.plan import Moment, ScenePlan
from models_export.scenes.request import FIRST_RESERVED_SEED, SceneRequest
from models_export.scenes.scenario import SCENARIOS, STRAIGHT_WORLDS
from models_export.scenes.vehicles import STYLES, sample_vehicle
from models_export.scenes.writer import scene_document
from service.errors import QuadliftError
from service.site import site_document

EVALUATION_SHA256 = "1192333835ef20e89ee143da47ccfe0f1b38d222ea3272412d12fd69336e9692"
"""Of the published set; :func:`evaluation_digest` must give it."""
SCENES, STEPS, RATE_HZ = 10, 10, 5.0
"""Per scenario: 100 frame sets of four cameras."""
_SEED_STRIDE = 100_000
_FIRST_DRAWN, _DRAWN_SEEDS = FIRST_RESERVED_SEED + 1_000_000, 1_000_000_000
"""Seeds of the sets that are drawn."""
_WORLDS: Mapping[str, tuple[str, ...]] = {
    "easy": STRAIGHT_WORLDS,
    "moderate": ("intersection", "curve", "t-junction", "curve", "intersection", "garage"),
    "hard": ("intersection", "straight", "t-junction", "curve", "garage"),
}
_DECIMALS = 3
"""Millimetres and milliradians: coarser than what processors differ in, finer than what matters."""


def evaluation_requests(scenario: str) -> tuple[SceneRequest, ...]:
    """The scenes of one of ``SCENARIOS``: worlds and rigs in turn, every fifth with distorting lenses."""
    first = FIRST_RESERVED_SEED + _SEED_STRIDE * SCENARIOS.index(scenario)
    worlds, requests = _WORLDS[scenario], []
    for k in range(SCENES):
        world = worlds[k % len(worlds)]
        rig = RIGS[(k + k // len(RIGS)) % len(RIGS)]
        if rig == "turn" and world == "straight":
            rig = "sides"
        requests.append(SceneRequest(first + k, world, STEPS, RATE_HZ, scenario=scenario, rig=rig, distorted=k % 5 == 4))
    return tuple(requests)


def drawn_requests(draw: int, scenes: int, steps: int) -> tuple[SceneRequest, ...]:
    """A second evaluation set, another for every number ``draw``: the same three scenarios with seeds, worlds and rigs drawn.

    Its seeds are reserved ones, which no training scene has, and none of the fixed set's.
    """
    rng, requests = np.random.default_rng(draw), []
    for scenario in SCENARIOS:
        for seed in rng.choice(_DRAWN_SEEDS, scenes, replace=False):
            world = str(rng.choice(_WORLDS[scenario]))
            rig = str(rng.choice([rig for rig in RIGS if rig != "turn" or world != "straight"]))
            distorted = bool(rng.random() < 1 / 5)
            requests.append(
                SceneRequest(_FIRST_DRAWN + int(seed), world, steps, RATE_HZ, scenario=scenario, rig=rig, distorted=distorted)
            )
    return tuple(requests)


def evaluation_folder(request: SceneRequest) -> str:
    """Name of a scene's folder in the cache."""
    return f"{request.scenario}-{request.world}-{request.seed}"


def evaluation_digest(scenarios: Iterable[str] = SCENARIOS) -> str:
    """SHA-256 (hex) over descriptions and truth of all scenes; of pictures nothing but what they are drawn from.

    Pixels, and with them visible fractions, differ a little between OpenGL drivers; they are left out.
    """
    digest = hashlib.sha256(json.dumps(_rounded(_fleet_description())).encode())
    for scenario in scenarios:
        for request in evaluation_requests(scenario):
            text = json.dumps(_description(ScenePlan(request)), sort_keys=True, separators=(",", ":"))
            digest.update(text.encode())
    return digest.hexdigest()


def check_digest() -> None:
    """Raises QuadliftError when this generator's evaluation set is not the published one."""
    found = evaluation_digest()
    if found != EVALUATION_SHA256:
        raise QuadliftError(
            f"the generator makes another evaluation set than the published one: {found[:16]}, not {EVALUATION_SHA256[:16]}.",
            field="EVALUATION_SHA256",
            remedy="Scores would not compare. Undo the change, or raise GENERATOR, store the new digest and score again.",
        )


def missing_requests(cache: Path, scenarios: Iterable[str]) -> list[SceneRequest]:
    """Scenes that the cache does not hold complete and of this generator."""
    return [r for name in scenarios for r in evaluation_requests(name) if not _is_rendered(cache / evaluation_folder(r), r)]


def _is_rendered(folder: Path, request: SceneRequest) -> bool:
    path = folder / "scene.json"
    if not path.is_file():
        return False
    try:
        found = json.loads(path.read_text("utf-8"))
    except json.JSONDecodeError:
        return False
    return bool(found == json.loads(json.dumps(scene_document(ScenePlan(request)))))


def _fleet_description() -> list[object]:
    """One body of each style: its size, number of faces and mean distances from its middle."""
    rng, found = np.random.default_rng(0), dict[str, ActorModel]()
    while len(found) < len(STYLES):
        model = sample_vehicle(rng)
        found.setdefault(model.shape, model)
    bodies = [found[style.name] for style in STYLES]
    return [[m.shape, m.dims_lwh, len(m.mesh), np.abs(m.mesh.corners).mean((0, 1)), m.mesh.looks.mean(0)] for m in bodies]


def _description(plan: ScenePlan) -> object:
    static = plan.static_mesh()
    return _rounded(
        {
            "scene": scene_document(plan),
            "site": _site_description(plan),
            "light": vars(plan.light),
            "films": [vars(film) for film in plan.films],
            "lamps": plan.lamp_heads,
            "static": [len(static), static.corners.reshape(-1, 3).mean(0), static.looks.mean(0)],
            "moments": [_moment_description(moment) for moment in plan.moments()],
        }
    )


def _site_description(plan: ScenePlan) -> dict[str, object]:
    """The site's numbers. How exact it calls them changes neither pictures nor truth."""
    document = site_document(plan.site)
    del document["accuracy"]
    return document


def _moment_description(moment: Moment) -> dict[str, object]:
    return {
        "captured_at_ns": moment.captured_at_ns,
        "ids": moment.ids,
        "classes": moment.classes,
        "shapes": [model.shape for model in moment.models],
        "center": moment.center,
        "dims_lwh": moment.dims_lwh,
        # As a direction, for angles near pi could round to either side.
        "heading": _directions(moment.poses[:, 2]),
        "velocity": moment.velocity,
    }


def _directions(yaw: Array) -> Array:
    return np.stack([np.cos(yaw), np.sin(yaw)], -1)


def _rounded(value: object) -> object:
    """JSON-ready, all floats at ``_DECIMALS``."""
    if isinstance(value, Mapping):
        return {str(k): _rounded(v) for k, v in value.items()}
    if isinstance(value, np.ndarray):
        return _rounded(value.tolist())
    if isinstance(value, list | tuple):
        return [_rounded(v) for v in value]
    if isinstance(value, float):
        # No minus zero.
        return round(value, _DECIMALS) + 0.0
    return value
