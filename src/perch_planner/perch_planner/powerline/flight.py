"""Simulation of a solved problem with the model at 1 ms, for its checks and its trajectory. [P:V-B]"""

from __future__ import annotations

from functools import lru_cache

import casadi as ca
import numpy as np

from perch_core.components import components
from perch_core.rotor_model import INPUTS, STATES, RotorModel, rk4

STEP = 1e-3  # upper bound [s], as in the paper


@lru_cache(maxsize=8)
def _flow(model: RotorModel) -> ca.Function:
    x, u, h = ca.SX.sym("x", STATES), ca.SX.sym("u", INPUTS), ca.SX.sym("h")
    return ca.Function("flow", [x, u, h], [ca.vertcat(*rk4(model, components(x), components(u), h))])


@lru_cache(maxsize=64)
def _chain(model: RotorModel, steps: int) -> ca.Function:
    return _flow(model).mapaccum(f"chain{steps}", steps)


def simulate(model: RotorModel, start: np.ndarray, rates: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Integrate the model under piecewise constant thrust rates.

    Args:
        model: constants.
        start: state, shape (17,).
        rates: thrust rates of each of N equal intervals [N/s], shape (N, 4).
        duration: of all intervals together [s].

    Returns:
        Times from 0 [s], shape (m + 1,), states with unit quaternions, shape (m + 1, 17), and the rate in force after
        each state, shape (m + 1, 4), the last repeated.
    """
    intervals = len(rates)
    per_interval = max(1, int(np.ceil(duration / intervals / STEP)))
    h = duration / (intervals * per_interval)
    inputs = np.repeat(np.asarray(rates, float), per_interval, axis=0)
    # One interval at a time: the chain's length then depends on the step only, and few chains are built.
    chain = _chain(model, per_interval)
    states = np.empty((len(inputs) + 1, STATES))
    states[0] = start
    for k in range(intervals):
        rows = slice(k * per_interval, (k + 1) * per_interval)
        block = chain(states[rows.start], inputs[rows].T, h)
        states[rows.start + 1 : rows.stop + 1] = np.array(block).T
    states[:, 3:7] /= np.linalg.norm(states[:, 3:7], axis=1, keepdims=True)
    return np.linspace(0.0, duration, len(states)), states, np.vstack([inputs, inputs[-1:]])
