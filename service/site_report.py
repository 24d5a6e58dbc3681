"""What the cameras of a site see of the ground: the check before anybody sends a frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.table import Table

from service.geometry.camera import Camera
from service.geometry.ground import Ground
from service.geometry.transforms import Array
from service.site import Site

HORIZON_M = 1000.0
"""Ground that is farther away counts as the horizon."""

_COLUMN_SAMPLES = 200


@dataclass(frozen=True, eq=False)
class CameraReport:
    """One camera's place and what it sees."""

    camera_id: str
    position_m: Array
    """(3,) in the world."""
    height_m: float
    """Height over the ground below it."""
    pitch_deg: float
    """Positive looks down."""
    near_m: float
    """Nearest visible ground on the picture's middle column, metres along the ground; NaN when there is none."""
    far_m: float
    """The farthest; infinite when the horizon is in the picture."""

    @property
    def problem(self) -> str | None:
        """Why the camera cannot place vehicles on the ground, if so."""
        if self.height_m <= 0:
            return "below the ground"
        if np.isnan(self.near_m):
            return "sees no ground"
        return None


def camera_reports(site: Site) -> list[CameraReport]:
    """One report a camera, in the site's order."""
    return [_report(camera, site.ground) for camera in site.cameras]


def report_table(site: Site, reports: list[CameraReport]) -> Table:
    """The reports for a terminal."""
    table = Table(title=f"Site {site.id}")
    table.add_column("Camera")
    for header in ("Size (px)", "Position E, N, up (m)", "Height (m)", "Pitch (deg)", "Ground seen (m)"):
        table.add_column(header, justify="right")
    for camera, report in zip(site.cameras, reports, strict=True):
        table.add_row(
            report.camera_id,
            f"{camera.width} x {camera.height}",
            ", ".join(f"{value:.2f}" for value in report.position_m),
            f"{report.height_m:.2f}",
            f"{report.pitch_deg:.1f}",
            report.problem or f"{report.near_m:.1f} to {'horizon' if np.isinf(report.far_m) else f'{report.far_m:.1f}'}",
            style="red" if report.problem else None,
        )
    return table


def _report(camera: Camera, ground: Ground) -> CameraReport:
    position = camera.position_m
    rows = np.linspace(camera.height - 1, 0, _COLUMN_SAMPLES)
    rays = camera.rays_world(np.stack([np.full_like(rows, (camera.width - 1) / 2), rows], -1))
    points = ground.intersect(position, rays)
    distance = np.linalg.norm(points[:, :2] - position[:2], axis=1)
    hits = distance[np.isfinite(distance)]
    far = hits.max() if len(hits) else np.nan
    sees_horizon = len(hits) and (len(hits) < len(distance) or far > HORIZON_M)
    forward = camera.R_cam_world[2]
    return CameraReport(
        camera.id,
        position,
        float(position[2] - ground.height_at(position)),
        float(np.degrees(-np.arcsin(np.clip(forward[2], -1, 1)))),
        float(hits.min()) if len(hits) else np.nan,
        np.inf if sees_horizon else float(far),
    )
