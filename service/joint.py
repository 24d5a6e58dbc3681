"""The joint solve: what several cameras see of one vehicle, solved as one box.

The cameras' terms are added up at one common state, not their boxes: a single camera's box is linearised where that camera
believes the vehicle, which may be metres off, and counts the road and the size for itself. Here edges, headings and depths
count for every camera, and what the cameras share counts once: the ground, and the size, which all of them have from the
same network looking at the same car (the mean of them, no better known than by one).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from service.association import Index
from service.geometry.boxes import YAW
from service.geometry.transforms import Array
from service.residuals import GROUND, BoxProblem, NormalEquations
from service.solver import SolverSettings, covariance_of, solve

_SHARED = slice(0, YAW)
"""Terms of the prior that cameras share: where the search began, and the size; the heading is each camera's own."""


@dataclass(frozen=True, eq=False)
class JointProblem:
    """M vehicles, each with the terms of all its cameras."""

    members: BoxProblem
    """K cameras' terms, vehicle by vehicle."""
    vehicle: Index
    """(K,) whose they are, ascending; every vehicle has some."""
    first: Index
    """(M,) row of each vehicle's first member."""

    def normal_equations(self, state: Array) -> NormalEquations:
        """Sums over the cameras at the vehicles' states (M, 7)."""
        each = self.members.normal_equations(state[self.vehicle])
        return NormalEquations(*(np.add.reduceat(part, self.first) for part in each))

    def take(self, index: NDArray[np.bool_]) -> JointProblem:
        """The vehicles at a mask (M,)."""
        mine = index[self.vehicle]
        return joint(self.members.take(mine), (np.cumsum(index) - 1)[self.vehicle[mine]])


def joint(members: BoxProblem, vehicle: Index) -> JointProblem:
    """Of K terms and the vehicle (K,) of each, ascending without gaps."""
    return JointProblem(members, vehicle, np.flatnonzero(np.diff(vehicle, prepend=-1)))


def solve_jointly(
    terms: BoxProblem, vehicle: Index, start: Array, settings: SolverSettings, tail_share: float = 1.0
) -> tuple[Array, Array]:
    """States (M, 7) and covariances (M, 7, 7) of vehicles, each from the terms of all its cameras.

    terms: K, by ``vehicle`` (K,) ascending. start: (M, 7). tail_share: how far out the rows' tails begin, over where they do
    for one camera. The terms' headings count as axes: each is taken from the side, and the turn, that is nearest to the
    start's; the states' yaw is not wrapped.
    """
    count = np.bincount(vehicle)[vehicle]
    share = 1.0 / np.sqrt(count)
    prior, weight, tail = terms.prior.copy(), terms.prior_weight.copy(), terms.tail * tail_share
    half_turns = np.round((prior[:, YAW] - start[vehicle, YAW]) / np.pi)
    prior[:, YAW] -= np.pi * half_turns
    weight[:, _SHARED] *= share[:, None]
    tail[:, GROUND] *= share
    members = replace(
        terms,
        prior=prior,
        prior_weight=weight,
        ground_weight=terms.ground_weight * share,
        tail=tail,
    )
    state, hessian = solve(joint(members, vehicle), start, settings)
    return state, covariance_of(hessian)


def shared_covariance(covariance: Array, terms: BoxProblem) -> Array:
    """Covariances (K, 2, 2) of x and y for the part of K boxes' errors, covariances (K, 7, 7), that cameras share.

    The road's error and the size's shift all cameras' boxes of a vehicle, each along its own ray. Two boxes are then apart by
    the difference of the shifts, which this, added to both boxes' covariances, covers however the rays run.
    """
    # The box's response to each shared term's sigma: a column of P J' / sigma.
    ground = (covariance[:, :2, 2] - 0.5 * covariance[:, :2, 5]) * terms.ground_weight[:, None]
    size = covariance[:, :2, 3:6] * terms.prior_weight[:, None, 3:6]
    return ground[:, :, None] * ground[:, None, :] + size @ size.transpose(0, 2, 1)
