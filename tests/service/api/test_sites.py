"""/sites: the registry over HTTP, cameras that join and leave while the site runs, and the newest frames."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest


def put(client: Any, path: str, document: Any) -> Any:
    """PUT with NaN and Infinity written as Python does."""
    return client.put(path, content=json.dumps(document), headers={"content-type": "application/json"})


def test_a_site_comes_and_goes(client: Any, tools: Any) -> None:
    body = {**tools.site_body("north"), "id": "other"}
    created = put(client, "/sites/other", body)
    assert created.status_code == 201
    assert put(client, "/sites/other", body).status_code == 200
    document = client.get("/sites/other").json()
    assert document == created.json()
    assert put(client, "/sites/other", document).json() == document
    assert [site["id"] for site in client.get("/sites").json()] == ["demo", "other"]
    assert client.delete("/sites/other").status_code == 204
    for response in (client.get("/sites/other"), client.delete("/sites/other"), client.get("/sites/other/cameras/north")):
        assert tools.error(response, 404)["field"] == "site"


def test_cameras_join_and_leave_at_run_time(client: Any, tools: Any) -> None:
    path = "/sites/demo/cameras/west"
    assert put(client, path, tools.camera_document("west")).status_code == 201
    assert client.get(path).json()["width"] == 128
    answer = tools.detect(client, {"west": tools.jpeg()}).json()
    assert {name: camera["status"] for name, camera in answer["cameras"].items()} == {
        "north": "missing", "east": "missing", "west": "ok",
    }  # fmt: skip
    assert put(client, path, tools.camera_document("west", width=64)).status_code == 200
    assert tools.error(tools.detect(client, {"west": tools.jpeg()}), 422)["field"] == "west"
    assert client.delete(path).status_code == 204
    assert tools.error(tools.detect(client, {"west": tools.jpeg()}), 404)["field"] == "west"
    tools.error(client.delete(path), 404)
    tools.error(client.get(path), 404)


NAN_K = [[float("nan"), 0, 63.5], [0, 90.0, 31.5], [0, 0, 1]]
SINGULAR_K = [[0.0, 0, 63.5], [0, 90.0, 31.5], [0, 0, 1]]
SINGULAR_POSE = [[0.0] * 4 for _ in range(3)] + [[0, 0, 0, 1]]
SCALED_POSE = [[2.0, 0, 0, 0], [0, 2.0, 0, 0], [0, 0, 2.0, 0], [0, 0, 0, 1]]


@pytest.mark.parametrize(
    ("changes", "field", "says"),
    [
        ({"K": NAN_K}, "K.0.0", "nan"),
        ({"K": [[float("inf"), 0, 1], [0, 1, 1], [0, 0, 1]]}, "K.0.0", "inf"),
        ({"K": SINGULAR_K}, "K", "singular"),
        ({"T_cam_world": SINGULAR_POSE}, "T_cam_world", "singular"),
        ({"T_cam_world": SCALED_POSE}, "T_cam_world", "rigid"),
        ({"distortion": [0.1]}, "distortion", "1 coefficients"),
        ({"width": 0}, "width", "0"),
        ({"colour": "red"}, "colour", "red"),
        ({"K": [[10**400, 0, 1], [0, 1, 1], [0, 0, 1]]}, "K", ""),
    ],
)
def test_bad_calibration_names_the_field(client: Any, tools: Any, changes: dict[str, Any], field: str, says: str) -> None:
    camera = tools.camera_document("west", **changes)
    for path, body, prefix in (
        ("/sites/demo/cameras/west", camera, ""),
        ("/sites/demo", {"id": "demo", "cameras": [camera]}, "cameras.0."),
    ):
        error = tools.error(put(client, path, body), 422)
        assert error["code"] == "invalid_calibration"
        assert error["field"].startswith(prefix + field)
        assert says in error["message"]
        assert error["remedy"]
    assert client.get("/sites/demo").json()["cameras"][0]["id"] == "north"
    assert tools.detect(client).status_code == 200


@pytest.mark.parametrize(
    "content", [b"", b"{", b"\xff\xfe", b"[" * 100_000, b"1" * 5000, b"null", b"[]", b'{"id": "demo", "cameras": 3}']
)
def test_bodies_that_are_no_site(client: Any, tools: Any, content: bytes) -> None:
    for path in ("/sites/demo", "/sites/demo/cameras/west"):
        error = tools.error(client.put(path, content=content), 422)
        assert error["field"]
        assert error["remedy"]
    assert tools.detect(client).status_code == 200


def test_ids_must_agree(client: Any, tools: Any) -> None:
    assert tools.error(put(client, "/sites/other", tools.site_body()), 422)["field"] == "id"
    assert tools.error(put(client, "/sites/demo/cameras/west", tools.camera_document("south")), 422)["field"] == "id"
    assert tools.error(put(client, "/sites/a%20b", {"id": "a b"}), 422)["field"] == "id"
    tools.error(put(client, "/sites/nowhere/cameras/west", tools.camera_document("west")), 404)


def test_limits(start: Callable[..., Any], tools: Any) -> None:
    client = start(max_cameras=2, max_sites=1, max_body_bytes=20_000)
    assert tools.error(put(client, "/sites/demo/cameras/west", tools.camera_document("west")), 413)["field"] == "cameras"
    assert tools.error(put(client, "/sites/other", {"id": "other"}), 413)["field"] == "site"
    assert tools.error(client.put("/sites/demo", content=bytes(30_000)), 413)["field"] == "body"


def test_sites_survive_a_restart(start: Callable[..., Any], tools: Any, tmp_path: Path) -> None:
    first = start(data_dir=tmp_path)
    put(first, "/sites/demo/cameras/west", tools.camera_document("west"))
    kept = first.get("/sites/demo").json()
    assert json.loads((tmp_path / "demo.json").read_text()) == kept
    first.delete("/sites/demo")
    assert not list(tmp_path.iterdir())


def test_frames_of_the_last_sets(client: Any, tools: Any) -> None:
    tools.error(client.get("/sites/demo/frames/north"), 404)
    sent = {"north": tools.jpeg(), "east": tools.png()}
    for _ in range(9):
        tools.detect(client, sent)
    tools.detect(client, {"east": sent["east"]})
    newest = client.get("/sites/demo/frames/north")
    assert newest.content == sent["north"]
    assert newest.headers["content-type"] == "image/jpeg"
    assert newest.headers["x-sequence"] == "9"
    assert client.get("/sites/demo/frames/east").headers["content-type"] == "image/png"
    assert client.get("/sites/demo/frames/north?sequence=3").headers["x-sequence"] == "3"
    assert tools.error(client.get("/sites/demo/frames/north?sequence=2"), 404)["field"] == "sequence"
    assert tools.error(client.get("/sites/demo/frames/north?sequence=x"), 422)["field"] == "sequence"
    assert tools.error(client.get("/sites/demo/frames/west"), 404)["field"] == "west"


def test_frames_are_bounded_in_bytes_and_can_be_off(start: Callable[..., Any], tools: Any) -> None:
    client = start(viewer_max_bytes=3 * len(tools.jpeg()))
    for _ in range(5):
        tools.detect(client)
    kept = [client.get(f"/sites/demo/frames/north?sequence={n}").status_code for n in range(1, 6)]
    assert kept == [404, 404, 404, 404, 200]
    off = start(viewer=False)
    tools.detect(off)
    assert "QUADLIFT_VIEWER" in tools.error(off.get("/sites/demo/frames/north"), 404)["remedy"]


def test_a_full_disk_stops_changes_and_nothing_else(
    start: Callable[..., Any], tools: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    client = start(data_dir=tmp_path)
    before = (tmp_path / "demo.json").read_bytes()

    def full(_: int) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    for change in (
        client.put("/sites/demo", json=tools.site_body("north")),
        client.put("/sites/new", json={**tools.site_body(), "id": "new"}),
        client.delete("/sites/demo/cameras/north"),
    ):
        error = tools.error(change, 507)
        assert (error["code"], error["field"]) == ("storage", "data_dir")
        assert "No space left" in error["message"]
        assert error["remedy"]
    assert tools.detect(client).json()["cameras"].keys() == {"north", "east"}
    assert client.get("/health/ready").status_code == 200
    assert [path.name for path in tmp_path.iterdir()] == ["demo.json"]
    assert (tmp_path / "demo.json").read_bytes() == before
