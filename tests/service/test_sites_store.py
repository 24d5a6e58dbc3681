"""The registry of sites: limits, persistence, and what a failed write leaves behind."""

from __future__ import annotations

import errno
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from service.errors import CalibrationError, NotFoundError, StorageError, TooLargeError
from service.geometry.camera import Camera
from service.site import Site
from service.sites_store import SitesStore


def camera(camera_id: str) -> Camera:
    return Camera(camera_id, 64, 64, np.array([[50.0, 0, 32], [0, 50.0, 32], [0, 0, 1]]), np.eye(4))


def ids(store: SitesStore) -> list[str]:
    return [site.id for site in store.sites()]


@pytest.mark.parametrize("on_disk", [False, True])
def test_put_get_delete(tmp_path: Path, on_disk: bool) -> None:
    store = SitesStore(tmp_path / "sites" if on_disk else None)
    assert store.put(Site("b"))
    assert store.put(Site("a"))
    assert not store.put(Site("a", (camera("north"),)))
    assert ids(store) == ["a", "b"]
    assert store.get("a").cameras[0].id == "north"
    store.delete("a")
    assert ids(store) == ["b"]
    for missing in (lambda: store.get("a"), lambda: store.delete("a"), lambda: store.put_camera("a", camera("x"))):
        with pytest.raises(NotFoundError):
            missing()


def test_sites_and_cameras_survive(tmp_path: Path) -> None:
    store = SitesStore(tmp_path)
    store.put(Site("demo"))
    assert store.put_camera("demo", camera("north"))
    assert not store.put_camera("demo", camera("north"))
    store.put_camera("demo", camera("east"))
    store.delete_camera("demo", "north")
    with pytest.raises(NotFoundError):
        store.delete_camera("demo", "north")
    assert [c.id for c in SitesStore(tmp_path).get("demo").cameras] == ["east"]
    store.delete("demo")
    assert ids(SitesStore(tmp_path)) == []


def test_limits_leave_the_store_as_it_was() -> None:
    store = SitesStore(max_sites=1, max_cameras=1)
    store.put(Site("demo", (camera("north"),)))
    with pytest.raises(TooLargeError):
        store.put(Site("other"))
    with pytest.raises(TooLargeError):
        store.put_camera("demo", camera("east"))
    assert ids(store) == ["demo"]
    assert len(store.get("demo").cameras) == 1


def full(*_: object, **__: object) -> None:
    raise OSError(errno.ENOSPC, "No space left on device")


def read_only(*_: object, **__: object) -> None:
    raise OSError(errno.EROFS, "Read-only file system")


FAULTS = [("os.fsync", full), ("json.dump", full), ("tempfile.mkstemp", read_only), ("pathlib.Path.replace", read_only)]


@pytest.mark.parametrize(("call", "fault"), FAULTS)
def test_a_failed_write_changes_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, call: str, fault: Callable[..., None]
) -> None:
    store = SitesStore(tmp_path)
    store.put(Site("demo"))
    monkeypatch.setattr(call, fault)
    with pytest.raises(StorageError) as caught:
        store.put_camera("demo", camera("north"))
    assert (caught.value.status, caught.value.field) == (507, "data_dir")
    assert "demo" in str(caught.value)
    monkeypatch.undo()
    assert store.get("demo").cameras == ()
    assert SitesStore(tmp_path).get("demo").cameras == ()
    assert [path.name for path in tmp_path.iterdir()] == ["demo.json"]
    assert store.put_camera("demo", camera("north"))


def test_a_site_whose_file_stays_is_not_dropped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    store = SitesStore(tmp_path)
    store.put(Site("demo"))
    monkeypatch.setattr("pathlib.Path.unlink", read_only)
    with pytest.raises(StorageError, match="Read-only"):
        store.delete("demo")
    assert ids(store) == ["demo"]


def test_at_the_start_a_site_may_live_in_memory_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    store = SitesStore(tmp_path)
    monkeypatch.setattr("tempfile.mkstemp", read_only)
    assert store.put(Site("demo"), must_keep=False)
    assert ids(store) == ["demo"]
    assert "in memory only" in caplog.text


def test_a_damaged_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "demo.json").write_text('{"id": "de')
    with pytest.raises(CalibrationError) as caught:
        SitesStore(tmp_path)
    assert "demo.json" in str(caught.value)


def test_changes_from_many_threads_are_all_kept(tmp_path: Path) -> None:
    store = SitesStore(tmp_path)
    store.put(Site("demo"))
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(lambda i: store.put_camera("demo", camera(f"c{i}")), range(12)))
    assert len(store.get("demo").cameras) == 12
    assert len(SitesStore(tmp_path).get("demo").cameras) == 12
