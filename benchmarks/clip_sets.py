"""The shipped clip as frame sets and truth, for benchmarks that run in process."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import Any

from clients.clip import Clip, open_clip
from models_export.data.dataset import SceneTruth, parse_truth
from service.frames import EncodedFrame, FrameSet
from service.site import Site, parse_site


def clip_site(clip: Clip, cameras: int | None = None) -> Site:
    """The clip's site, cut to its first ``cameras`` cameras."""
    site = parse_site(clip.site)
    return replace(site, cameras=site.cameras[:cameras])


def clip_frame_sets(clip: Clip | None = None, cameras: int | None = None, site: Site | None = None) -> list[FrameSet]:
    """Every step of a clip as one frame set, all frames in memory; ``site`` replaces the clip's calibration."""
    clip = clip or open_clip()
    site = replace(site, cameras=site.cameras[:cameras]) if site else clip_site(clip, cameras)
    start = time.time_ns()
    sets = []
    for step in range(clip.steps):
        captured = start + round(step * 1e9 / clip.rate_hz)
        frames = tuple(EncodedFrame(camera.id, clip.frame(camera.id, step), captured) for camera in site.cameras)
        sets.append(FrameSet(site, frames, captured, step + 1))
    return sets


def clip_truth(clip: Clip) -> list[SceneTruth]:
    """The world boxes of every step, with the site's cameras in order."""
    documents: tuple[dict[str, Any], ...] = clip.truth
    return [parse_truth(document, clip.camera_ids) for document in documents]
