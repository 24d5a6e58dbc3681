"""Damped Gauss-Newton (Levenberg and Marquardt) on many small problems at once, for lifting and for fusion."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, Self

import numpy as np
from numpy.typing import NDArray

from service.geometry.boxes import STATE_DIM
from service.geometry.transforms import Array
from service.residuals import NormalEquations

MIN_DIM_M, MAX_DIM_M = 0.2, 60.0
_FIRST_DAMPING, _MIN_DAMPING, _MAX_DAMPING = 1e-3, 1e-6, 1e6
_LESS_DAMPING, _MORE_DAMPING = 0.2, 10.0
_CONDITION_FLOOR = 1e-9
_DIAGONAL = np.arange(STATE_DIM)


class Problem(Protocol):
    """N independent problems, each over a box's seven unknowns."""

    def normal_equations(self, state: Array) -> NormalEquations:
        """Of every problem at its state (N, 7)."""

    def take(self, index: NDArray[np.bool_]) -> Self:
        """The problems at a mask (N,)."""


@dataclass(frozen=True)
class SolverSettings:
    """When to stop."""

    iterations: int = 6
    """Most steps; boxes that have converged stand still before that."""
    step_tolerance: float = 0.5
    """A box has converged with a step shorter than this, in its own sigmas (Mahalanobis). Near the solution each step leaves a
    small part of the distance before it: what remains after the last one is far below a sigma."""


def solve(problem: Problem, start: Array, settings: SolverSettings) -> tuple[Array, Array]:
    """States (N, 7) of least cost, and the Hessians (N, 7, 7) there, from starts (N, 7).

    Each box has its own damping, and leaves the batch when it has converged. Its last, short step is taken on trust: the
    Hessian is that of the place before it.
    """
    state, hessian = start.copy(), np.empty((len(start), STATE_DIM, STATE_DIM))
    rows, damping = np.arange(len(start)), np.full(len(start), _FIRST_DAMPING)
    at, now = start, problem.normal_equations(start)
    for _ in range(settings.iterations):
        damped = now.hessian.copy()
        damped[:, _DIAGONAL, _DIAGONAL] *= 1.0 + damping[:, None]
        step = np.linalg.solve(damped, -now.gradient[..., None])[..., 0]
        trial = at + step
        np.minimum(np.maximum(trial[:, 3:6], MIN_DIM_M), MAX_DIM_M, out=trial[:, 3:6])
        # Twice what the quadratic model promises: the step's squared length in the box's own sigmas.
        going = -(now.gradient * step).sum(1) > settings.step_tolerance**2
        if not going.all():
            done = ~going
            state[rows[done]], hessian[rows[done]] = trial[done], now.hessian[done]
            if not going.any():
                return state, hessian
            rows, damping, at, trial, problem = rows[going], damping[going], at[going], trial[going], problem.take(going)
            now = NormalEquations(*(kept[going] for kept in now))
        then = problem.normal_equations(trial)
        better = then.cost <= now.cost
        if better.all():
            at, now = trial, then
            damping = np.maximum(damping * _LESS_DAMPING, _MIN_DAMPING)
        else:
            at, now = np.where(better[:, None], trial, at), _chosen(better, then, now)
            damping = np.where(better, damping * _LESS_DAMPING, damping * _MORE_DAMPING)
            damping = np.minimum(np.maximum(damping, _MIN_DAMPING), _MAX_DAMPING)
    state[rows], hessian[rows] = at, now.hessian
    return state, hessian


def _chosen(better: NDArray[np.bool_], then: NormalEquations, now: NormalEquations) -> NormalEquations:
    """``then`` where the step was better (N,), else ``now``."""
    pick = [better.reshape(-1, *(1,) * (new.ndim - 1)) for new in then]
    return NormalEquations(*(np.where(p, new, old) for p, new, old in zip(pick, then, now, strict=True)))


def covariance_of(hessian: Array) -> Array:
    """Inverse Hessians (N, 7, 7), symmetric and positive definite."""
    # Scaled to a unit diagonal first: metres, radians and far boxes otherwise differ by many orders of magnitude.
    scale = 1.0 / np.sqrt(hessian[:, _DIAGONAL, _DIAGONAL])
    outer = scale[:, :, None] * scale[:, None, :]
    scaled = hessian * outer
    scaled[:, _DIAGONAL, _DIAGONAL] += _CONDITION_FLOOR
    inverse = np.linalg.inv(scaled) * outer
    symmetric: Array = 0.5 * (inverse + inverse.transpose(0, 2, 1))
    return symmetric
