"""The bare loop: decoding and the three networks on the same frames, with nothing around them."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from service.frames import FrameSet
from service.nets.canvas import Canvases
from service.pipeline import Pipeline
from service.stills import DetectedVehicles

PREPARE_S = 10.0
"""Seconds after which no further set is prepared."""


@dataclass(frozen=True, eq=False)
class _Work:
    frame_set: FrameSet
    crops: tuple[NDArray[np.uint8], ...]
    """What the multi-bin head gets for this set at each look, cut beforehand."""


class BareLoop:
    """Runs the networks of a pipeline over frame sets as fast as they go."""

    def __init__(self, pipeline: Pipeline, sets: Sequence[FrameSet]) -> None:
        self._pipeline = pipeline
        self._work = self._prepared(sets)

    def run(self, seconds: float, threads: int) -> tuple[int, float]:
        """Sets done by ``threads`` threads in about ``seconds``, and the seconds it really took."""
        done = [0] * threads
        started = time.perf_counter()

        def worker(number: int) -> None:
            turn = number
            while time.perf_counter() - started < seconds:
                self._run(self._work[turn % len(self._work)])
                turn += threads
                done[number] += 1

        workers = [threading.Thread(target=worker, args=(number,)) for number in range(threads)]
        for thread in workers:
            thread.start()
        for thread in workers:
            thread.join()
        return sum(done), time.perf_counter() - started

    def _run(self, work: _Work) -> None:
        pipeline = self._pipeline
        canvases = Canvases([still.small for still in pipeline.decode(work.frame_set)[0]])
        for network, fit in ((pipeline.detector.network, pipeline.detector.fit), (pipeline.depth.network, pipeline.depth.fit)):
            for batch in canvases.batches(fit):
                network.run(batch.pixels)
        for crops in work.crops:
            pipeline.multibin.network.run(crops)

    def _prepared(self, sets: Sequence[FrameSet]) -> list[_Work]:
        """As many of the sets as are prepared in ``PREPARE_S``: all of them, unless the networks are slow."""
        began, work = time.perf_counter(), [self._prepare(sets[0])]
        for frame_set in sets[1:]:
            if time.perf_counter() - began > PREPARE_S:
                break
            work.append(self._prepare(frame_set))
        return work

    def _prepare(self, frame_set: FrameSet) -> _Work:
        stills, settings = self._pipeline.decode(frame_set)[0], self._pipeline.settings
        images = [still.small for still in stills]
        found = self._pipeline.detector.detect(images, score_threshold=settings.score_threshold, nms_iou=settings.nms_iou)
        head = self._pipeline.multibin
        detected = DetectedVehicles.of(stills, found)
        first = detected.crops(head.spec.crop_px)
        _, second = detected.second_looks(head.estimate(first, detected.cls), head.spec.crop_px, settings.refine_shift)
        return _Work(frame_set, tuple(crops.pixels for crops in (first, second) if len(crops)))
