"""Clusters of boxes, each made one box: from the terms of its cameras, or else from their boxes' covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from service.association import Index
from service.confidence import mean_score
from service.geometry.boxes import STATE_DIM, YAW, Boxes, box_states
from service.geometry.transforms import Array, wrap_angle
from service.joint import solve_jointly
from service.residuals import BoxProblem
from service.solver import SolverSettings

_DIMS = slice(3, 6)


def summable(boxes: Boxes, cluster: Index) -> Boxes:
    """K boxes with covariances that may be added up as information: size n-fold, as n cameras share its error.

    cluster: (K,) ascending from 0 without gaps, one box a camera.
    """
    others = np.bincount(cluster)[cluster] - 1.0
    covariance = boxes.covariance.copy()
    covariance[:, _DIMS, _DIMS] += others[:, None, None] * boxes.covariance[:, _DIMS, _DIMS]
    return replace(boxes, covariance=covariance)


def combine(boxes: Boxes, cluster: Index, terms: BoxProblem | None, settings: SolverSettings, tail_share: float = 1.0) -> Boxes:
    """One box a cluster from K boxes as :func:`summable` gives them, ``cluster`` (K,) ascending from 0 without gaps.

    With the K boxes' terms, clusters of several are solved from these, their tails ``tail_share`` as far out; else they are
    combined by information.
    """
    rows = int(cluster[-1]) + 1
    first = np.searchsorted(cluster, np.arange(rows))
    axis = _circular_axis(boxes, cluster, rows)
    aligned = np.cos(boxes.yaw - axis[cluster]) >= 0
    evidence = np.bincount(cluster, np.where(aligned, 1.0, -1.0) * boxes.flip_log_odds, rows)
    state = box_states(boxes)
    state[:, YAW] = wrap_angle(boxes.yaw - axis[cluster] + np.where(aligned, 0.0, np.pi))
    # Relative to the cluster's first member: world coordinates may be large, differences within a cluster are not.
    reference = np.zeros((rows, STATE_DIM))
    reference[:, :3], reference[:, YAW] = state[first, :3], axis
    state[:, :3] -= reference[cluster, :3]
    if terms is None:
        fused, covariance = _by_information(state, boxes.covariance, first)
        fused += reference
    else:
        # Where cameras do not agree the sum has a minimum near each: the surest is right more often than the mean.
        surest = _surest(boxes.covariance, cluster, first)
        fused, covariance = state[surest] + reference, boxes.covariance[surest]
        several = np.bincount(cluster) > 1
        if several.all():
            fused, covariance = solve_jointly(terms, cluster, fused, settings, tail_share)
        elif several.any():
            mine = np.flatnonzero(several[cluster])
            vehicle = (np.cumsum(several) - 1)[cluster[mine]]
            fused[several], covariance[several] = solve_jointly(terms.take(mine), vehicle, fused[several], settings, tail_share)
    return Boxes(
        center=fused[:, :3],
        dims_lwh=fused[:, _DIMS],
        yaw=wrap_angle(fused[:, YAW] + np.where(evidence < 0, np.pi, 0.0)),
        score=mean_score(boxes.score, cluster, rows),
        cls=_voted_class(boxes, cluster, rows),
        covariance=covariance,
        flip_log_odds=np.abs(evidence),
    )


def _by_information(state: Array, covariance: Array, first: Index) -> tuple[Array, Array]:
    """States (M, 7) and covariances (M, 7, 7) of clusters that begin at rows ``first`` (M,)."""
    information = np.linalg.inv(covariance)
    weighted = (information @ state[..., None])[..., 0]
    fused_covariance = np.linalg.inv(np.add.reduceat(information, first))
    fused = (fused_covariance @ np.add.reduceat(weighted, first)[..., None])[..., 0]
    return fused, 0.5 * (fused_covariance + fused_covariance.transpose(0, 2, 1))


def _surest(covariance: Array, cluster: Index, first: Index) -> Index:
    """The row (M,) in each cluster whose place in the plane is known best."""
    variance = covariance[:, 0, 0] + covariance[:, 1, 1]
    surest: Index = np.lexsort((variance, cluster))[first]
    return surest


def _circular_axis(boxes: Boxes, cluster: Index, rows: int) -> Array:
    """Weighted mean axes (M,) of headings that may be flipped by pi: in [-pi/2, pi/2]."""
    weight = 1.0 / boxes.covariance[:, YAW, YAW]
    sine = np.bincount(cluster, weight * np.sin(2 * boxes.yaw), rows)
    cosine = np.bincount(cluster, weight * np.cos(2 * boxes.yaw), rows)
    axis: Array = 0.5 * np.arctan2(sine, cosine)
    return axis


def _voted_class(boxes: Boxes, cluster: Index, rows: int) -> Index:
    classes = int(boxes.cls.max()) + 1
    votes = np.bincount(cluster * classes + boxes.cls, boxes.score, rows * classes).reshape(rows, classes)
    winner: Index = votes.argmax(1).astype(np.int64)
    return winner
