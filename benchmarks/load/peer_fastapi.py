"""The service that one writes first: FastAPI, uvicorn, a form with the frames.

Two ways to use the cores, chosen by the number of processes: two processes of one thread each for the networks, or one process
with two. Requests wait for a thread without a limit: nothing is refused, nothing expires, and a client that goes away does not
take its work along. Beyond its rate, latency grows for as long as the load lasts. (Uvicorn's ``limit_concurrency``, unset by
default, answers 503 above a number of connections.) With two processes, the kernel gives each connection to one of them for
good, so that one may queue while the other idles.
"""

from __future__ import annotations

import argparse
import asyncio
import os
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import asynccontextmanager

import uvicorn
from fastapi import FastAPI, Request, Response
from starlette.datastructures import UploadFile

from benchmarks.load.peer_model import PeerModel

THREADS = "PEER_THREADS"
"""Environment variable with the number of threads of each process; worker processes inherit it."""


def create_app() -> FastAPI:
    """The app, for uvicorn."""
    threads = int(os.environ[THREADS])
    pool = ThreadPoolExecutor(threads)

    @asynccontextmanager
    async def lifespan(app: FastAPI) -> AsyncIterator[None]:
        app.state.model = await asyncio.to_thread(PeerModel, threads)
        yield
        pool.shutdown()

    app = FastAPI(lifespan=lifespan)

    @app.get("/health/ready")
    async def ready() -> dict[str, str]:
        return {"status": "ready"}

    @app.post("/detect")
    async def detect(request: Request) -> Response:
        async with request.form() as form:
            frames = {name: await part.read() for name, part in form.items() if isinstance(part, UploadFile)}
        content = await asyncio.get_running_loop().run_in_executor(pool, request.app.state.model.detect, frames)
        return Response(content, media_type="application/json")

    return app


def main() -> None:
    """Serve until SIGTERM."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--host", required=True)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--processes", type=int, required=True)
    parser.add_argument("--threads", type=int, required=True, help="of each process")
    options = parser.parse_args()
    os.environ[THREADS] = str(options.threads)
    # With one process uvicorn serves in this one.
    uvicorn.run(
        "benchmarks.load.peer_fastapi:create_app",
        factory=True,
        host=options.host,
        port=options.port,
        workers=options.processes,
        log_level="warning",
        access_log=False,
    )


if __name__ == "__main__":
    main()
