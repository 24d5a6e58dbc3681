"""Frames pushed by the ingest client and by `quadlift feed` come out of a real service's stream."""

from __future__ import annotations

import asyncio
import socket
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from clients.client import AsyncClient, Client, ServiceError
from clients.feed import Fed, FeedPlan, app, feed_all, parse_cameras
from clients.ingest import IngestClient
from clients.sources import JpegFiles, NetworkStream, SourceError, Video, open_source
from service.schemas import Detections


@pytest.fixture
def url(service_url: str, site_document: dict[str, Any]) -> str:
    with Client(service_url) as client:
        client.put_site(site_document)
    return service_url


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "north.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, (128, 64))
    for i in range(5):
        writer.write(np.full((64, 128, 3), 40 * i, np.uint8))
    writer.release()
    return path


async def collect(url: str, messages: list[Detections], opened: asyncio.Event) -> None:
    async with AsyncClient(url) as client:
        # The client does not say when its stream is open.
        asyncio.get_running_loop().call_later(1.0, opened.set)
        async for message in client.stream("demo"):
            messages.append(message)


async def streamed(url: str, sending: Any) -> list[Detections]:
    """The messages that appear on the stream while something is being sent."""
    messages: list[Detections] = []
    opened = asyncio.Event()
    listening = asyncio.create_task(collect(url, messages, opened))
    await opened.wait()
    await sending
    # A busy machine may take seconds for the first.
    for _ in range(100):
        if messages:
            break
        await asyncio.sleep(0.1)
    await asyncio.sleep(0.3)
    listening.cancel()
    await asyncio.gather(listening, return_exceptions=True)
    return messages


def test_the_ingest_client_feeds_the_stream(url: str, frames: dict[str, bytes]) -> None:
    async def sending() -> None:
        start = datetime.now(UTC)
        async with IngestClient(url, "demo") as ingest:
            for i in range(5):
                for camera, data in frames.items():
                    await ingest.send(camera, data, start + timedelta(milliseconds=50 * i))
                await asyncio.sleep(0.05)
            assert ingest.refused == 0

    messages = asyncio.run(streamed(url, sending()))
    assert not messages[-1].degraded
    assert messages[-1].captured_at > messages[0].captured_at


def test_refusals_are_kept(url: str) -> None:
    async def scenario() -> tuple[int, str]:
        async with IngestClient(url, "demo") as ingest:
            await ingest.send("north", b"no picture", datetime.now(UTC))
            for _ in range(100):
                if ingest.refused:
                    break
                await asyncio.sleep(0.02)
            return ingest.refused, ingest.errors[-1].code

    assert asyncio.run(scenario()) == (1, "invalid_frame")


def test_an_unknown_site_is_refused_at_once(url: str) -> None:
    with pytest.raises(ServiceError, match="nowhere") as caught:
        asyncio.run(IngestClient(url, "nowhere").open())
    assert caught.value.status == 404


def test_a_time_without_a_zone_is_refused(url: str, frames: dict[str, bytes]) -> None:
    async def scenario() -> None:
        async with IngestClient(url, "demo") as ingest:
            await ingest.send("north", frames["north"], datetime(2026, 1, 1))

    with pytest.raises(ValueError, match="time zone"):
        asyncio.run(scenario())


def test_folders_are_fed_in_step(url: str, clip_folder: Path) -> None:
    sources = parse_cameras([f"{camera}={clip_folder / camera}" for camera in ("north", "east")])
    fed = {camera: Fed() for camera in sources}
    messages = asyncio.run(streamed(url, feed_all(FeedPlan(url, "demo", sources, rate_hz=20), fed)))
    assert all(result == Fed(sent=3) for result in fed.values())
    assert {message.cameras["north"].skew_ms for message in messages if not message.degraded} == {0.0}


def test_the_command_feeds_a_video_and_says_what_happened(url: str, video: Path) -> None:
    result = CliRunner().invoke(app, ["demo", f"north={video}", "--url", url])
    assert result.exit_code == 0, result.output
    assert "north: 5 frames sent, 0 refused, 0 lost" in result.output


def test_the_command_stops_after_its_time(url: str, clip_folder: Path) -> None:
    result = CliRunner().invoke(app, ["demo", f"north={clip_folder / 'north'}", "--url", url, "--loop", "--seconds", "1"])
    assert result.exit_code == 0, result.output
    assert "north: 1" in result.output


@pytest.mark.parametrize("wrong", ["north", "north=", "=x", "north=/nowhere/at/all"])
def test_sources_that_are_none_end_in_one_line(wrong: str) -> None:
    result = CliRunner().invoke(app, ["demo", wrong])
    assert result.exit_code == 1
    assert result.output.startswith("Error: ")


def test_a_site_that_is_none_ends_in_one_line(url: str, clip_folder: Path) -> None:
    result = CliRunner().invoke(app, ["nowhere", f"north={clip_folder / 'north'}", "--url", url])
    assert result.exit_code == 1
    assert "nowhere" in result.output


def test_frames_go_by_while_nobody_listens(clip_folder: Path) -> None:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        nobody = f"http://127.0.0.1:{probe.getsockname()[1]}"
    fed = {"north": Fed()}
    sources = parse_cameras([f"north={clip_folder / 'north'}"])
    asyncio.run(feed_all(FeedPlan(nobody, "demo", sources, rate_hz=50), fed))
    assert fed["north"] == Fed(lost=3)


def test_sources_are_what_they_look_like(video: Path, clip_folder: Path, tmp_path: Path) -> None:
    assert isinstance(open_source("rtsp://user:secret@camera/1"), NetworkStream)
    assert isinstance(open_source(str(clip_folder / "north")), JpegFiles)
    opened = open_source(str(video))
    assert isinstance(opened, Video)
    assert opened.rate_hz == pytest.approx(25.0)
    assert len(list(opened.frames())) == 5
    (tmp_path / "no.avi").write_bytes(b"no video")
    with pytest.raises(SourceError, match=r"no\.avi"):
        open_source(str(tmp_path / "no.avi"))


def test_a_live_source_that_breaks_is_opened_again(url: str, video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's stream reader takes files too: this one breaks after five pictures."""
    monkeypatch.setattr("clients.feed.RECONNECT_S", 0.01)
    fed = {"north": Fed()}

    async def scenario() -> None:
        feeding = asyncio.create_task(feed_all(FeedPlan(url, "demo", {"north": NetworkStream(str(video))}), fed))
        while fed["north"].sent < 12:
            await asyncio.sleep(0.01)
        feeding.cancel()
        await asyncio.gather(feeding, return_exceptions=True)

    asyncio.run(asyncio.wait_for(scenario(), 20))
    assert fed["north"].lost == 0


def test_a_live_source_that_is_not_there_is_sought_again(url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clients.feed.RECONNECT_S", 0.01)
    fed = {"north": Fed()}

    async def scenario() -> None:
        source = NetworkStream(str(tmp_path / "nothing"))
        async with asyncio.timeout(0.5):
            await feed_all(FeedPlan(url, "demo", {"north": source}), fed)

    with pytest.raises(TimeoutError):
        asyncio.run(scenario())
    assert "cannot be opened" in fed["north"].last_refusal
