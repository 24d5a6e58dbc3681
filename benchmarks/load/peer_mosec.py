"""mosec: an HTTP server in Rust, and worker processes with the networks behind Unix sockets.

Requests are MessagePack, its own way for binary input: a map of JPEG files by camera. Requests beyond ``capacity`` (1024
waiting by default) are answered 429. One without an answer after ``timeout`` (3 s by default) is answered 408; up to that time
all wait, so that beyond its rate latency grows up to it. A client that goes away does not take its request along: it is run
for nobody.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping

from mosec import Server, Worker
from mosec.mixin import MsgpackMixin

from benchmarks.load.peer_model import PeerModel

WORKERS = "--processes"


class DetectWorker(MsgpackMixin, Worker):
    """One frame set a request."""

    resp_mime_type = "application/json"

    def __init__(self) -> None:
        """Load the networks; called once in each worker process."""
        super().__init__()
        self._model = PeerModel()

    def forward(self, data: Mapping[str, bytes]) -> bytes:
        """JSON of the boxes."""
        return self._model.detect(data)

    def serialize(self, data: bytes) -> bytes:
        """The answer is JSON already."""
        return data


def main() -> None:
    """Serve until SIGTERM; mosec itself reads its options (``--address``, ``--port``) from the command line."""
    server = Server()
    server.append_worker(DetectWorker, num=int(sys.argv[sys.argv.index(WORKERS) + 1]), route="/detect")
    server.run()


if __name__ == "__main__":
    main()
