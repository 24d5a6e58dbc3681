"""From what the networks read in detected vehicles to the measurements that lifting takes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from service.depth_scale import DepthReadings
from service.geometry.boxes import clip_extents, cut_edges
from service.geometry.camera import yaw_from_alpha
from service.geometry.transforms import Array
from service.measurements import Measurements
from service.nets.detector import edge_sigma
from service.nets.detector_spec import DetectorSpec
from service.nets.multibin import EDGES, UNCERTAIN, Multibin, MultibinEstimates, MultibinSpec
from service.stills import DetectedVehicles

DOUBT = 1.5
"""A head's sigmas are honest on average, but what a detector doubts the head reads worse than it knows: hidden vehicles, dark
ones, none. They are multiplied by exp(doubt * (1 - score)) (validation scenes; docs: lifting)."""
_UNKNOWN_YAW_SIGMA = np.pi / np.sqrt(3.0)
"""Standard deviation of an angle that may be any, radians."""


def read_vehicles(detected: DetectedVehicles, head: Multibin, least_shift: float) -> MultibinEstimates:
    """What a head reads of the vehicles; of those whose outlines and detected boxes disagree, at a second look."""
    estimates = head.estimate(detected.crops(head.spec.crop_px), detected.cls)
    again, crops = detected.second_looks(estimates, head.spec.crop_px, least_shift)
    return estimates.with_rows(again, head.estimate(crops, detected.cls[again])) if len(again) else estimates


def measure(
    detected: DetectedVehicles,
    estimates: MultibinEstimates,
    readings: DepthReadings,
    detector: DetectorSpec,
    multibin: MultibinSpec,
) -> Measurements:
    """What the networks say of all vehicles, in px of ``image``, each reading with its standard deviation."""
    if estimates.sigma is not None:
        doubt = np.exp(DOUBT * (1.0 - detected.score))
        estimates = replace(estimates, sigma=estimates.sigma * doubt[:, None])
    rows = [detected.still == number for number in range(len(detected.stills))]
    of_stills = list(zip(detected.stills, rows, strict=True))
    seen = np.concatenate([clip_extents(still.camera, detected.xyxy_px[own]) for still, own in of_stills])
    cut = np.concatenate([cut_edges(still.camera, seen[own]) for still, own in of_stills])
    xyxy, sigma_px, tangents_px, sigma_tangents_px = _outline(detected, seen, cut, estimates, detector)
    headed = np.isfinite(estimates.alpha)
    alpha, yaw = np.where(headed, estimates.alpha, 0.0), np.zeros(len(detected))
    for still, own in of_stills:
        yaw[own] = yaw_from_alpha(still.camera, alpha[own], estimates.center_px[own])
    sigma_yaw, sigma_dims = multibin.sigmas(estimates, detected.score, cut.any(1))
    return Measurements(
        camera_index=detected.still,
        xyxy_px=xyxy,
        sigma_px=sigma_px,
        dims_lwh=estimates.dims_lwh,
        sigma_dims=sigma_dims,
        yaw=yaw,
        sigma_yaw=np.where(headed, sigma_yaw, _UNKNOWN_YAW_SIGMA),
        flip_log_odds=np.where(headed, estimates.flip_log_odds, 0.0),
        score=detected.score,
        cls=detected.cls,
        depth_m=readings.depth_m,
        sigma_depth_m=readings.sigma_m,
        tangents_px=tangents_px,
        sigma_tangents_px=sigma_tangents_px,
    )


def _outline(
    detected: DetectedVehicles, seen: Array, cut: NDArray[np.bool_], estimates: MultibinEstimates, detector: DetectorSpec
) -> tuple[Array, Array, Array, Array]:
    """Edges (N, 4) and their standard deviations (N, 4), tangents (N, K) and theirs (N, K), px.

    Edges are the head's own where it reads any, else the detector's ``seen``; K is 0 where it reads no tangents. An edge that
    the image border cuts stays at the border, whatever the head makes of it.
    """
    nothing = np.zeros((len(detected), 0))
    if estimates.xyxy_px is None or estimates.sigma is None:
        scale = np.tile(np.array([still.scale for still in detected.stills]).reshape(-1, 2), 2)[detected.still]
        small = (seen + 0.5) / scale - 0.5
        return seen, edge_sigma(detector, small, detected.score, cut.any(1)) * scale, nothing, nothing
    edges = np.where(cut, seen, estimates.xyxy_px)
    sigma = estimates.sigma[:, len(UNCERTAIN) - EDGES :]
    if estimates.tangents_px is None:
        return edges, sigma, nothing, nothing
    return edges, sigma[:, :EDGES], estimates.tangents_px, sigma[:, EDGES:]
