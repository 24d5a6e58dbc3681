"""The registry of sites: looked up by every request, changed at run time, kept on disk if a folder is given."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from service.errors import NotFoundError, StorageError, TooLargeError
from service.geometry.camera import Camera
from service.site import Site, load_site, save_site, sync_folder

logger = logging.getLogger(__name__)

_SUFFIX = ".json"


class SitesStore:
    """Sites by id. Thread-safe: lookups never wait for a disk, changes happen one at a time.

    With a folder, a change is on disk (written whole or not at all) before anybody sees it; one that cannot be written is not
    made. Sites that are known stay known whatever becomes of the disk.
    """

    def __init__(self, folder: Path | None = None, *, max_sites: int = 256, max_cameras: int = 16) -> None:
        """Load every site kept in ``folder``. Raises CalibrationError naming the file that cannot be used."""
        self._folder = folder
        self._max_sites = max_sites
        self._max_cameras = max_cameras
        self._changing = threading.Lock()
        self._sites: dict[str, Site] = {}
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            for path in sorted(folder.glob(f"[!.]*{_SUFFIX}")):
                site = load_site(path)
                self._sites[site.id] = site

    def sites(self) -> list[Site]:
        """All sites, by id."""
        sites = self._sites
        return [sites[site_id] for site_id in sorted(sites)]

    def get(self, site_id: str) -> Site:
        """The site with an id. Raises NotFoundError."""
        site = self._sites.get(site_id)
        if site is None:
            raise NotFoundError(
                f"there is no site '{site_id[:80]}'.", field="site", remedy="GET /sites lists them; PUT /sites/{id} makes one."
            )
        return site

    def put(self, site: Site, *, must_keep: bool = True) -> bool:
        """Add or replace a site; True when it is new. Raises TooLargeError when there are too many sites or cameras.

        Raises StorageError when it cannot be written; without ``must_keep`` that is logged, and the site lives in memory.
        """
        with self._changing:
            return self._put(site, must_keep)

    def delete(self, site_id: str) -> None:
        """Drop a site. Raises NotFoundError, StorageError."""
        with self._changing:
            self.get(site_id)
            if self._folder is not None:
                with _storing(site_id):
                    (self._folder / f"{site_id}{_SUFFIX}").unlink(missing_ok=True)
                    sync_folder(self._folder)
            self._sites = {other: site for other, site in self._sites.items() if other != site_id}

    def put_camera(self, site_id: str, camera: Camera) -> bool:
        """Let a camera join a site, or replace it; True when it is new. Raises NotFoundError, TooLargeError, StorageError."""
        before, after = self._change(site_id, lambda site: site.with_camera(camera))
        return len(after.cameras) > len(before.cameras)

    def delete_camera(self, site_id: str, camera_id: str) -> None:
        """Let a camera leave a site. Raises NotFoundError, StorageError."""
        self._change(site_id, lambda site: site.without_camera(camera_id))

    def _change(self, site_id: str, change: Callable[[Site], Site]) -> tuple[Site, Site]:
        with self._changing:
            before = self.get(site_id)
            after = change(before)
            self._put(after)
            return before, after

    def _put(self, site: Site, must_keep: bool = True) -> bool:
        is_new = site.id not in self._sites
        if len(site.cameras) > self._max_cameras:
            raise TooLargeError(
                f"{len(site.cameras)} cameras; a site may have {self._max_cameras}.",
                field="cameras",
                remedy="Split the site, or raise QUADLIFT_MAX_CAMERAS.",
            )
        if is_new and len(self._sites) >= self._max_sites:
            raise TooLargeError(
                f"there are {len(self._sites)} sites already, as many as this service may have.",
                field="site",
                remedy="DELETE one, or raise QUADLIFT_MAX_SITES.",
            )
        if self._folder is not None:
            try:
                with _storing(site.id):
                    save_site(site, self._folder / f"{site.id}{_SUFFIX}")
            except StorageError as error:
                if must_keep:
                    raise
                logger.error("%s It lives in memory only.", error, extra={"site": site.id})
        # A new dict each time: readers hold the old one or the new one, and need no lock.
        self._sites = {**self._sites, site.id: site}
        return is_new


@contextmanager
def _storing(site_id: str) -> Iterator[None]:
    """Turn what a disk says into an error that a caller can understand."""
    try:
        yield
    except OSError as error:
        logger.error("The data folder cannot be written: %s", error, extra={"site": site_id})
        raise StorageError(
            f"the change to site '{site_id}' could not be written ({error.strerror or 'no reason given'}), so it was not made.",
            field="data_dir",
            remedy="Make room on the service's disk, or make its data folder writable; then try again.",
        ) from error
