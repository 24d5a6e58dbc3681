"""Vehicles driven by CARLA's traffic manager, drawn from a seed, near a point of the map."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from models_export.data.carla_convert import CarlaPose
from models_export.data.carla_session import Session
from service.errors import InputError

if TYPE_CHECKING:
    import carla

NEAR_M = 120.0
"""Vehicles start within this distance of the rig's anchor."""
_GAP_M = 2.5


def spawn_traffic(session: Session, anchor: CarlaPose, count: int, seed: int) -> int:
    """Put up to ``count`` four-wheeled vehicles on the road near the anchor and hand them to the traffic manager.

    Gives how many found a place: spawn points are few, and some are taken. Two-wheelers are left out: in several releases
    their bounding boxes have no width. Raises InputError when no spawn point is near.
    """
    rng = np.random.default_rng(seed)
    blueprints = _four_wheeled(session)
    centre = session.carla.Location(anchor.x, anchor.y, anchor.z)
    points = [point for point in session.map.get_spawn_points() if point.location.distance(centre) < NEAR_M]
    if count and not points:
        raise InputError(
            f"no spawn point of {session.map_name} lies within {NEAR_M:.0f} m of ({anchor.x:.1f}, {anchor.y:.1f}).",
            field="anchor",
            remedy="Put the rig's anchor on the road that the cameras look at.",
        )
    session.traffic.set_global_distance_to_leading_vehicle(_GAP_M)
    spawned = 0
    for index in rng.permutation(len(points)):
        if spawned == count:
            break
        blueprint = blueprints[int(rng.integers(len(blueprints)))]
        _paint(blueprint, rng)
        vehicle = session.world.try_spawn_actor(blueprint, points[index])
        if vehicle is None:
            continue
        session.keep(vehicle)
        vehicle.set_autopilot(True, session.options.traffic_port)
        # Lamps follow weather, hour and braking.
        session.traffic.update_vehicle_lights(vehicle, True)
        spawned += 1
    return spawned


def _four_wheeled(session: Session) -> list[carla.ActorBlueprint]:
    """Blueprints of cars, vans, trucks and buses, by id, so that a seed means the same on any server."""
    found = [
        blueprint
        for blueprint in session.world.get_blueprint_library().filter("vehicle.*")
        if blueprint.has_attribute("number_of_wheels") and blueprint.get_attribute("number_of_wheels").as_int() >= 4
    ]
    if not found:
        raise InputError("the server has no four-wheeled vehicles.", field="vehicle.*", remedy="Use CARLA's own package.")
    return sorted(found, key=lambda blueprint: str(blueprint.id))


def _paint(blueprint: carla.ActorBlueprint, rng: np.random.Generator) -> None:
    if blueprint.has_attribute("color"):
        colors = blueprint.get_attribute("color").recommended_values
        if colors:
            blueprint.set_attribute("color", colors[int(rng.integers(len(colors)))])
