"""The hard path: in cameras whose view is hard, the depth-guided detector adds to what was lifted.

It takes the same images and the depth net's maps, made metric on the road, and gives 3D boxes of its own with a covariance.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from service.association import Index
from service.depth_scale import DepthScale, ground_inverse_depth
from service.errors import PackError
from service.geometry.boxes import Boxes
from service.geometry.camera import Camera, UInt8Image
from service.geometry.ground import Ground
from service.geometry.transforms import Array
from service.guided_boxes import join, on_the_road, suppress_bev, world_boxes
from service.hardness import HardnessSettings, hardness_of
from service.nets.depth import InverseDepth
from service.nets.detections import Detections
from service.nets.guided import GuidedDetector, guide_maps, metric_map
from service.nets.pack import Pack
from service.site import Site
from service.stills import Still

logger = logging.getLogger(__name__)

HardMode = Literal["auto", "always", "never"]
Method = Literal["map", "paper"]


@dataclass(frozen=True)
class GuidanceSettings:
    """Tuning of the hard path."""

    hardness: HardnessSettings = field(default_factory=HardnessSettings)
    """When ``auto`` takes a camera's view for hard."""
    score_threshold: float = 0.45
    """Guided boxes of a lower score are dropped. On held-out training scenes a lower one costs more precision than it gains
    recall (docs/hard-mode.md)."""
    nms_iou: float = 0.4
    """2D boxes that overlap a better one by more are dropped."""
    duplicate_iou: float = 0.1
    """Bird's-eye IoU above which two guided boxes of a camera are one vehicle."""
    duplicate_distance_m: float = 1.0
    """Centres nearer than this are one vehicle, metres."""
    gate: float = 9.21
    """Largest squared Mahalanobis distance at which a guided box is a lifted one's: 99 % of two degrees of freedom."""
    max_distance_m: float = 3.0
    """Boxes farther apart are two vehicles, metres."""


@dataclass(frozen=True, eq=False)
class View:
    """What is known of one camera's frame before the hard path."""

    still: Still
    detections: Detections
    """2D detections, in px of the still's ``small``."""
    inverse: InverseDepth
    """Of the still's ``small``."""
    scale: DepthScale | None
    """Makes the map metric; None where it cannot be."""


class Guidance:
    """The hard path over one pack's depth-guided detector. Safe to use from several threads."""

    def __init__(self, detector: GuidedDetector, classes: Sequence[str], mode: HardMode, settings: GuidanceSettings) -> None:
        self.detector = detector
        self.mode = mode
        self.settings = settings
        self._classes = _class_map(detector.spec.classes, classes)
        # Weak keys: a camera that left takes its road with it. Written twice at worst, with the same values.
        self._roads: WeakKeyDictionary[Camera, tuple[tuple[int, int], Array]] = WeakKeyDictionary()

    @staticmethod
    def of(pack: Pack, mode: HardMode, settings: GuidanceSettings) -> Guidance | None:
        """The hard path of a pack, or None where it is off: by ``never``, or by ``auto`` with a pack without the network.

        Raises PackError for ``always`` with such a pack.
        """
        if mode == "never":
            return None
        if "guided" in pack.networks:
            return Guidance(GuidedDetector(pack.networks["guided"]), pack.manifest.classes, mode, settings)
        if mode == "always":
            raise PackError(
                f"pack '{pack.manifest.name}' has no network 'guided'.",
                field="hard_mode",
                remedy="Use hard_mode auto or never, or add one: quadlift train guided, quadlift export.",
            )
        logger.info("Pack '%s' has no network 'guided': hard_mode auto is never.", pack.manifest.name)
        return None

    def hard_views(self, views: Sequence[View]) -> NDArray[np.bool_]:
        """Which views (C,) are taken the hard way."""
        if self.mode == "always":
            return np.ones(len(views), dtype=bool)
        chosen = self.settings.hardness
        hard = [hardness_of(view.still.small, view.detections.xyxy_px, chosen).is_hard(chosen) for view in views]
        return np.array(hard, dtype=bool)

    def add(
        self,
        views: Sequence[View],
        hard: NDArray[np.bool_],
        site: Site,
        lifted: Boxes,
        camera_index: Index,
        method: Method,
    ) -> tuple[Boxes, Index]:
        """Boxes of all cameras, and their cameras (N,), after guided boxes joined those of the ``hard`` (C,) ones.

        With method ``paper`` guided boxes take the place of lifted ones, as the paper has it, and know nothing of the road.
        """
        if not hard.any():
            return lifted, camera_index
        chosen = [int(number) for number in np.flatnonzero(hard)]
        guided = self._boxes([views[c] for c in chosen], site, method)
        settings = self.settings
        parts, owners = [lifted.take(~hard[camera_index])], [camera_index[~hard[camera_index]]]
        for number, own in zip(chosen, guided, strict=True):
            if method != "paper":
                own = join(lifted.take(camera_index == number), own, settings.gate, settings.max_distance_m)
            parts.append(own)
            owners.append(np.full(len(own), number, np.int64))
        boxes, index = Boxes.concatenate(parts), np.concatenate(owners)
        order = np.argsort(index, kind="stable")
        return boxes.take(order), index[order]

    def warm_up(self, images: Sequence[UInt8Image]) -> None:
        """Run the detector once on images (H, W, 3) RGB."""
        spec, sizes = self.detector.spec, [(image.shape[1], image.shape[0]) for image in images]
        maps = [guide_maps(spec, size, 1.0, None, np.zeros(spec.guide_grid(size)[0])) for size in sizes]
        self.detector.detect(images, maps, [1.0] * len(images))

    @property
    def max_width(self) -> int | None:
        """Width of the images that the detector wants, px; None: what the 2D detector sees."""
        size = self.detector.spec.fit.size
        return None if size is None else size[0]

    def _boxes(self, views: Sequence[View], site: Site, method: Method) -> list[Boxes]:
        settings, told = self.settings, site.accuracy
        whole = self.max_width is not None
        images = [view.still.whole if whole else view.still.small for view in views]
        cameras = [view.still.whole_camera if whole else view.still.small_camera for view in views]
        focal = [float(camera.K[1, 1]) for camera in cameras]
        maps = [self._maps(view, camera, site.ground) for view, camera in zip(views, cameras, strict=True)]
        found = self.detector.detect(images, maps, focal, score_threshold=settings.score_threshold, nms_iou=settings.nms_iou)
        boxes = []
        for camera, detections in zip(cameras, found, strict=True):
            own = world_boxes(camera, detections, self._classes[detections.cls])
            if method != "paper":
                own = on_the_road(own, site.ground, camera, told.ground_m, told.ground_per_m)
            boxes.append(suppress_bev(own, settings.duplicate_iou, settings.duplicate_distance_m))
        return boxes

    def _maps(self, view: View, camera: Camera, ground: Ground) -> NDArray[np.float32]:
        """Guides of a view; the camera is at the size of the image that goes with them."""
        spec, size = self.detector.spec, (camera.width, camera.height)
        shape, stride = spec.guide_grid(size)
        known = self._roads.get(view.still.site_camera)
        if known is None or known[0] != size:
            known = size, ground_inverse_depth(camera, ground, shape, stride)
            self._roads[view.still.site_camera] = known
        inverse = view.inverse.at_width(view.still.small_camera.width, camera.width).on_cells(shape, stride)
        metric = None if view.scale is None else metric_map(inverse, view.scale.scale, view.scale.shift)
        return guide_maps(spec, size, float(camera.K[1, 1]), metric, known[1])


def _class_map(ours: Sequence[str], packs: Sequence[str]) -> NDArray[np.int64]:
    """The pack's index (C,) of each class of the detector. Raises PackError for a class that the pack has not."""
    missing = [name for name in ours if name not in packs]
    if missing:
        raise PackError(f"class '{missing[0]}' is none of the pack's.", field="guided", remedy="Export the pack again.")
    return np.array([list(packs).index(name) for name in ours], dtype=np.int64)
