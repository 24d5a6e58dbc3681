"""What to render: a scene follows from these values alone."""

from __future__ import annotations

from dataclasses import dataclass

from models_export.scenes.cameras import HEIGHT_PX, RIGS, WIDTH_PX
from models_export.scenes.light import INDOOR_WEATHERS, OUTDOOR_WEATHERS
from models_export.scenes.roads import WORLDS
from models_export.scenes.scenario import check_scenario
from service.errors import InputError

FIRST_RESERVED_SEED = 9_000_000
"""Worlds, rigs and traffic of seeds from here on are kept for evaluation."""


@dataclass(frozen=True)
class SceneRequest:
    """One scene's order. Call :meth:`check` on values from outside."""

    seed: int
    world: str = "intersection"
    steps: int = 8
    rate_hz: float = 10.0
    cameras: int = 4
    quality: int | None = None
    """JPEG quality; drawn from ``film.QUALITIES`` per camera when None."""
    weather: str | None = None
    """One of ``light.WEATHERS``; drawn when None."""
    vehicles: int | None = None
    """Vehicles in the world, parked ones included; drawn when None."""
    scenario: str | None = None
    """One of ``scenario.SCENARIOS``: shapes traffic and weather; None leaves everything to chance."""
    rig: str = "poles"
    """One of ``cameras.RIGS``."""
    size: tuple[int, int] | None = (WIDTH_PX, HEIGHT_PX)
    """Width and height of the pictures, px; one of ``cameras.SIZES`` is drawn when None."""
    distorted: bool = False
    """Whether lenses distort."""

    def check(self, *, reserved: bool = True) -> None:
        """Raises InputError naming the field when a value is unknown or two do not go together.

        reserved: whether seeds from ``FIRST_RESERVED_SEED`` on are allowed.
        """
        if not reserved and self.seed >= FIRST_RESERVED_SEED:
            raise InputError(
                f"{self.seed} is reserved for evaluation.", field="seed", remedy=f"Use seeds below {FIRST_RESERVED_SEED}."
            )
        if self.world not in WORLDS:
            raise InputError(f"there is no world {self.world!r}.", field="world", remedy=f"Use one of {', '.join(WORLDS)}.")
        if self.rig not in RIGS:
            raise InputError(f"there is no rig {self.rig!r}.", field="rig", remedy=f"Use one of {', '.join(RIGS)}.")
        allowed = INDOOR_WEATHERS if self.world == "garage" else OUTDOOR_WEATHERS
        if self.weather is not None and self.weather not in allowed:
            raise InputError(
                f"the world {self.world} has no weather {self.weather!r}.",
                field="weather",
                remedy=f"Use one of {', '.join(allowed)}.",
            )
        if self.rig == "turn" and self.world == "straight":
            raise InputError("the world straight has no turn.", field="rig", remedy="Use the rig poles or sides there.")
        check_scenario(self.scenario, self.world, self.weather)


def world_of(name: str, index: int, weather: str | None, scenario: str | None, rig: str) -> str:
    """The world of scene number ``index``: the named one; for ``mix`` those that fit in turn, every third an intersection."""
    if name != "mix":
        return name
    fitting = [
        w for w in WORLDS if _fits(SceneRequest(0, w, weather=weather, scenario=scenario, rig=rig if rig in RIGS else "turn"))
    ]
    if not fitting:
        raise InputError("no world goes with the other options.", field="world", remedy="Change weather, scenario or rig.")
    others = [w for w in fitting if w != "intersection"] or fitting
    if index % 3 == 0 and "intersection" in fitting:
        return "intersection"
    return others[(index - index // 3 - 1) % len(others)]


def _fits(request: SceneRequest) -> bool:
    try:
        request.check()
    except InputError:
        return False
    return True


def parse_size(text: str) -> tuple[int, int] | None:
    """Width and height of ``1284x384``; None for ``mix``. Raises InputError."""
    if text == "mix":
        return None
    width, _, height = text.partition("x")
    if not (width.isdigit() and height.isdigit() and 64 <= int(width) <= 4096 and 64 <= int(height) <= 4096):
        raise InputError(f"{text!r} is no picture size.", field="size", remedy="Give width x height in 64..4096, or mix.")
    return int(width), int(height)
