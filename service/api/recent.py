"""The newest frames of every site, for the viewer page; bounded in sets and in bytes."""

from __future__ import annotations

from collections import OrderedDict

from service.errors import NotFoundError
from service.frames import EncodedFrame, FrameSet

KEPT_SETS = 8
"""Frame sets kept of a site: a page that reads a message finds that message's frames, even a little later."""


class RecentFrames:
    """Frames of the last ``KEPT_SETS`` sets of each site. For use on the event loop only."""

    def __init__(self, max_bytes: int) -> None:
        """max_bytes: what all kept frames may take together; the oldest set goes first."""
        self._max_bytes = max_bytes
        self._sets: OrderedDict[tuple[str, int], dict[str, EncodedFrame]] = OrderedDict()
        self._bytes = 0

    @property
    def total_bytes(self) -> int:
        """Bytes of all kept frames."""
        return self._bytes

    def add(self, frame_set: FrameSet) -> None:
        """Keep the frames of a set."""
        self._sets[frame_set.site.id, frame_set.sequence] = {frame.camera_id: frame for frame in frame_set.frames}
        self._bytes += sum(len(frame.data) for frame in frame_set.frames)
        keys = self._keys(frame_set.site.id)
        for key in keys[:-KEPT_SETS]:
            self._drop(key)
        while self._bytes > self._max_bytes:
            self._drop(next(iter(self._sets)))

    def get(self, site_id: str, camera_id: str, sequence: int | None = None) -> tuple[int, EncodedFrame]:
        """Sequence and frame of a camera: the newest, or that of one set. Raises NotFoundError."""
        wanted = [key for key in sorted(self._keys(site_id), reverse=True) if sequence is None or key[1] == sequence]
        for key in wanted:
            frame = self._sets[key].get(camera_id)
            if frame is not None:
                return key[1], frame
        which = "no frame" if sequence is None else f"no frame of set {sequence}"
        raise NotFoundError(
            f"{which} of camera '{camera_id}' is kept.",
            field="sequence" if sequence is not None else "camera",
            remedy=f"The last {KEPT_SETS} sets are kept while memory allows; send frames with POST /detect.",
        )

    def forget_site(self, site_id: str) -> None:
        """Drop all frames of a site."""
        for key in self._keys(site_id):
            self._drop(key)

    def _keys(self, site_id: str) -> list[tuple[str, int]]:
        return [key for key in self._sets if key[0] == site_id]

    def _drop(self, key: tuple[str, int]) -> None:
        self._bytes -= sum(len(frame.data) for frame in self._sets.pop(key).values())
