"""What every peer serves: the pipeline over one site, from a camera's bytes to the JSON of the boxes.

It does less than Quadlift's service, in the peers' favour: one site, no check of the frames' headers, no limits, no account
of the cameras, no tracking. What costs time is the same: decoding, the networks, lifting and fusion.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import orjson

from service.frames import EncodedFrame, FrameSet
from service.nets.pack import load_pack
from service.pipeline import Pipeline, SetResult
from service.settings import Settings
from service.site import load_site

SITE_FILE = "PEER_SITE_FILE"
"""Environment variable with the path of the site's file; worker processes inherit it."""


class PeerModel:
    """The networks of the default pack, warm, for one site. Thread-safe."""

    def __init__(self, threads: int = 1) -> None:
        """For so many threads, and the site that ``PEER_SITE_FILE`` names.

        Raises QuadliftError, KeyError when there is none.
        """
        settings = Settings()
        self._site = load_site(Path(os.environ[SITE_FILE]))
        pack = load_pack(settings.pack, provider=settings.provider, intra_op_threads=1, concurrent_runs=threads)
        self._pipeline = Pipeline(pack)
        self._pipeline.warm_up()
        self._sequences = itertools.count(1)

    def detect(self, frames: Mapping[str, bytes]) -> bytes:
        """The boxes of one frame set as JSON; frames: JPEG files by camera. Raises FrameError when not one can be read."""
        now_ns = time.time_ns()
        encoded = tuple(EncodedFrame(camera_id, data, None) for camera_id, data in frames.items())
        return boxes_json(self._pipeline.run(FrameSet(self._site, encoded, now_ns, next(self._sequences))))


def boxes_json(result: SetResult) -> bytes:
    """What the service tells of each box, without its rounding."""
    boxes = result.boxes
    rows = zip(boxes.cls, boxes.score, boxes.center, boxes.dims_lwh, boxes.yaw, boxes.covariance, result.members, strict=True)
    documents = [
        {
            "class": result.classes[int(cls)],
            "score": score,
            "center": center,
            "size": size,
            "yaw": yaw,
            "covariance": covariance,
            "cameras": [result.camera_ids[camera] for camera in np.flatnonzero(seen)],
        }
        for cls, score, center, size, yaw, covariance, seen in rows
    ]
    return orjson.dumps({"boxes": documents}, option=orjson.OPT_SERIALIZE_NUMPY)
