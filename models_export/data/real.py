"""All real recordings that train: which part of each trains, which is held out, whom to thank."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from models_export.data import carla2d, pandaset_samples, roadside_train, traffic_videos
from models_export.data.detection import DetectionSample, Labels, VehicleSample
from models_export.data.nanodet import CREDIT
from models_export.data.teacher import AgreeConfig, agreed, read_candidates

ATTRIBUTIONS = (
    carla2d.ATTRIBUTION,
    pandaset_samples.ATTRIBUTION,
    traffic_videos.ATTRIBUTION,
    *roadside_train.ATTRIBUTION.values(),
)


@dataclass(frozen=True)
class RealData:
    """Where the recordings lie."""

    folder: Path
    """Holds the archives."""
    taught: Path | None = None
    """What `quadlift teach` wrote; without it the traffic videos stay out, and unlabelled vehicles of the roadside frames are
    ignored only where every clip has them."""
    agree: AgreeConfig = field(default_factory=AgreeConfig)

    def detection(self, classes: tuple[str, ...], max_width: int) -> tuple[list[DetectionSample], list[DetectionSample]]:
        """Training and held-out samples of the detector, in memory. Raises NotFoundError for an absent archive."""
        frames = roadside_train.ARCHIVE, carla2d.ARCHIVE, pandaset_samples.ARCHIVE, traffic_videos.ARCHIVE
        roadside, carla, pandaset, videos = (self.folder / name for name in frames)
        taught = self._taught(roadside)
        training: list[DetectionSample] = [
            *roadside_train.load_roadside(roadside, classes, max_width, suspected=taught),
            *carla2d.load_carla2d(carla, classes, max_width),
            *pandaset_samples.load_pandaset(pandaset, classes, max_width),
            *traffic_videos.load_videos(videos, taught, classes, max_width),
        ]
        held_out: list[DetectionSample] = [
            *roadside_train.load_roadside(roadside, classes, max_width, "validation"),
            *carla2d.load_carla2d(carla, classes, max_width, "test"),
            *pandaset_samples.load_pandaset(pandaset, classes, max_width, pandaset_samples.HELD_OUT_STEPS),
        ]
        return training, held_out

    def vehicles(self, classes: tuple[str, ...], max_width: int) -> tuple[list[VehicleSample], list[VehicleSample]]:
        """Training and held-out samples of the multi-bin head, in memory. Raises NotFoundError for an absent archive."""
        archive = self.folder / pandaset_samples.ARCHIVE
        steps = pandaset_samples.TRAINING_STEPS, pandaset_samples.HELD_OUT_STEPS
        training, held_out = (pandaset_samples.load_pandaset(archive, classes, max_width, part) for part in steps)
        return training, held_out

    def credits(self) -> tuple[str, ...]:
        """For checkpoint and manifest: sources and licences, the teacher's too where one had a part in it."""
        return (*ATTRIBUTIONS, *([f"teacher: {CREDIT}"] if self.taught else []))

    def _taught(self, roadside: Path) -> dict[str, Labels]:
        """By picture, what the teacher adds to the labels; labels of videos are all the teacher's."""
        if self.taught is None:
            return {}
        labelled = {frame.image: frame.labels for frame in roadside_train.read_frames(roadside)}
        nothing = Labels.concatenate([])
        return {
            name: agreed(seen, labelled.get(name, nothing), self.agree) for name, seen in read_candidates(self.taught).items()
        }
