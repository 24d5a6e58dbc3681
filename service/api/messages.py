"""From the pipeline's arrays to the messages of the wire contract, and to bytes. All of it blocks: call it in a thread."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import msgpack
import numpy as np
import orjson
from numpy.typing import NDArray

from service.frames import EncodedFrame, FrameSet
from service.geometry.boxes import STATE_DIM, Boxes
from service.schemas import Box, CameraStatus, Detections, Timing, rfc3339_from_ns

if TYPE_CHECKING:
    from service.pipeline import SetResult
    from service.tracking import TrackedBoxes

_DECIMALS = 4
"""A tenth of a millimetre; more digits only make messages longer. Rounded to five, a yaw below pi stays below pi."""
_YAW_DECIMALS = 5
_COVARIANCE_DECIMALS = 8


@dataclass(frozen=True, eq=False)
class Encoded:
    """One message as the bytes that readers get."""

    json: bytes
    msgpack: bytes | None


def finite_only(result: SetResult) -> tuple[SetResult, int]:
    """The result without boxes that hold a number which is not finite, and how many those were."""
    keep = _finite_rows(result.boxes)
    dropped = int(np.count_nonzero(~keep))
    if not dropped:
        return result, 0
    return replace(result, boxes=result.boxes.take(keep), members=result.members[keep]), dropped


def detections_message(frame_set: FrameSet, result: SetResult, tracked: TrackedBoxes | None, track_ms: float) -> Detections:
    """The message of a frame set; ``tracked`` is in the order of the result's boxes. All boxes must be finite."""
    boxes = result.boxes if tracked is None else tracked.boxes
    members = result.members if tracked is None else tracked.members
    cameras = _camera_statuses(frame_set, result)
    return Detections(
        site=frame_set.site.id,
        sequence=frame_set.sequence,
        captured_at=rfc3339_from_ns(frame_set.captured_at_ns),
        boxes=_boxes(
            boxes,
            [[result.camera_ids[c] for c in np.flatnonzero(row)] for row in members],
            result.classes,
            None if tracked is None else tracked.track_id,
            None if tracked is None else tracked.velocity,
        ),
        cameras=cameras,
        degraded=any(camera.status != "ok" for camera in cameras.values()),
        timing_ms=Timing(
            **{
                **{stage: round(ms, 3) for stage, ms in result.timing_ms.items()},
                "track": round(track_ms, 3),
                "total": round(result.timing_ms["total"] + track_ms, 3),
            }
        ),
    )


def per_camera_boxes(result: SetResult) -> dict[str, list[Box]]:
    """Each camera's own boxes before fusion."""
    own = {}
    for camera_id, boxes in zip(result.camera_ids, result.per_camera, strict=True):
        finite = boxes.take(_finite_rows(boxes))
        own[camera_id] = _boxes(finite, [[camera_id]] * len(finite), result.classes, None, None)
    return own


def encode_json(message: Detections) -> bytes:
    """A message as JSON."""
    return orjson.dumps(message.model_dump(by_alias=True, exclude_unset=True))


def encode(message: Detections, *, with_msgpack: bool) -> Encoded:
    """A message as JSON and, if anybody reads that, MessagePack."""
    document = message.model_dump(by_alias=True, exclude_unset=True)
    packed: bytes | None = msgpack.packb(document) if with_msgpack else None
    return Encoded(orjson.dumps(document), packed)


def _boxes(
    boxes: Boxes,
    cameras: Sequence[list[str]],
    classes: Sequence[str],
    track_ids: Sequence[str] | None,
    velocity: NDArray[np.float64] | None,
) -> list[Box]:
    center, size = np.round(boxes.center, _DECIMALS).tolist(), np.round(boxes.dims_lwh, _DECIMALS).tolist()
    yaw, score = np.round(boxes.yaw, _YAW_DECIMALS).tolist(), np.round(boxes.score, _DECIMALS).tolist()
    covariance = np.round(boxes.covariance, _COVARIANCE_DECIMALS).tolist()
    velocities = [None] * len(boxes) if velocity is None else np.round(velocity, _DECIMALS).tolist()
    return [
        Box(
            track_id=None if track_ids is None else track_ids[i],
            class_=classes[int(boxes.cls[i])],
            score=score[i],
            center=center[i],
            size=size[i],
            yaw=yaw[i],
            velocity=velocities[i],
            covariance=covariance[i],
            cameras=cameras[i],
        )
        for i in range(len(boxes))
    ]


def _camera_statuses(frame_set: FrameSet, result: SetResult) -> dict[str, CameraStatus]:
    frames = {frame.camera_id: frame for frame in frame_set.frames}
    return {
        camera.id: _refused_status(frame_set, camera.id)
        if camera.id not in frames
        else _frame_status(frame_set, frames[camera.id], result)
        for camera in frame_set.site.cameras
    }


def _refused_status(frame_set: FrameSet, camera_id: str) -> CameraStatus:
    refused = frame_set.refused.get(camera_id)
    if refused is None:
        return CameraStatus(status="missing")
    captured_at, skew_ms = _times(frame_set, refused.captured_at_ns)
    return CameraStatus(status="bad", captured_at=captured_at, skew_ms=skew_ms, detections=0, message=refused.reason)


def _frame_status(frame_set: FrameSet, frame: EncodedFrame, result: SetResult) -> CameraStatus:
    captured_at, skew_ms = _times(frame_set, frame.captured_at_ns)
    failure = result.failed.get(frame.camera_id)
    if failure is not None:
        return CameraStatus(status="bad", captured_at=captured_at, skew_ms=skew_ms, detections=0, message=failure.message)
    status: Literal["ok", "stale"] = "stale" if frame.camera_id in frame_set.stale else "ok"
    detections = result.detections.get(frame.camera_id, 0)
    camera = CameraStatus(status=status, captured_at=captured_at, skew_ms=skew_ms, detections=detections)
    # Fields that are not set are not sent: clients of services without the hard path see no change.
    return camera.model_copy(update={"hard": frame.camera_id in result.hard}) if "guided" in result.timing_ms else camera


def _times(frame_set: FrameSet, time_ns: int | None) -> tuple[str, float]:
    """A frame's capture time as RFC 3339, and its skew in ms; a frame without one has its set's."""
    known_ns = frame_set.captured_at_ns if time_ns is None else time_ns
    return rfc3339_from_ns(known_ns), (known_ns - frame_set.captured_at_ns) / 1e6


def _finite_rows(boxes: Boxes) -> NDArray[np.bool_]:
    numbers = (
        boxes.center,
        boxes.dims_lwh,
        boxes.yaw[:, None],
        boxes.score[:, None],
        boxes.covariance.reshape(len(boxes), STATE_DIM**2),
    )
    return np.asarray(np.isfinite(np.concatenate(numbers, axis=1)).all(axis=1), dtype=np.bool_)
