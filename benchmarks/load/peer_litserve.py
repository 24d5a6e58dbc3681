"""LitServe: HTTP processes that read forms, a queue between processes, and worker processes with the networks.

The queue has no limit. A worker that takes a request which has waited longer than ``timeout`` (30 s by default) answers it 504
without running it; until then all of them wait, so that beyond its rate latency grows up to that time. A client that goes away
does not take its request along: it is run for nobody.
"""

# No `from __future__ import annotations`: LitServe reads the annotations of `decode_request` and `encode_response` as classes.
import argparse
from collections.abc import Sequence
from typing import Any

import litserve
from fastapi import Request, Response
from starlette.datastructures import UploadFile

from benchmarks.load.peer_model import PeerModel


class DetectAPI(litserve.LitAPI):
    """One frame set a request."""

    def setup(self, device: str) -> None:
        """Load the networks; called once in each worker."""
        self._model = PeerModel()

    def decode_request(self, request: Request) -> dict[str, bytes]:
        """The frames by camera. LitServe hands over the form that it has read, whatever the annotation says."""
        form: Any = request
        return {name: part.file.read() for name, part in form.items() if isinstance(part, UploadFile)}

    def predict(self, x: dict[str, bytes]) -> bytes:
        """JSON of the boxes."""
        return self._model.detect(x)

    def encode_response(self, output: bytes) -> Response:
        """The answer as it goes out."""
        return Response(output, media_type="application/json")


class BatchedDetectAPI(DetectAPI):
    """Several frame sets at a time, where they wait already; each is run for itself, for a set is a batch of its frames."""

    def batch(self, inputs: Sequence[dict[str, bytes]]) -> list[dict[str, bytes]]:
        """The requests together."""
        return list(inputs)

    def predict(self, x: Any) -> Any:
        """JSON of the boxes of each."""
        return [self._model.detect(frames) for frames in x]

    def unbatch(self, output: list[bytes]) -> list[bytes]:
        """The answers one by one."""
        return output


def main() -> None:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--processes", type=int, required=True)
    parser.add_argument("--batch", type=int, default=1, help="frame sets that a worker takes together")
    options = parser.parse_args()
    path = "/detect"
    api = DetectAPI(api_path=path) if options.batch == 1 else BatchedDetectAPI(api_path=path, max_batch_size=options.batch)
    server = litserve.LitServer(api, accelerator="cpu", workers_per_device=options.processes)
    server.run(host=options.host, port=options.port, log_level="warning", access_log=False, generate_client_file=False)


if __name__ == "__main__":
    main()
