"""Verdicts of the bound check against Sturm's chain in exact rational arithmetic."""

from __future__ import annotations

import os

import numpy as np

import exact_sturm

from perch_core import bernstein
from perch_eval.campaign.progress import counted
from perch_eval.campaign.workers import in_processes
from perch_planner import bounds

_CHUNK = 100  # polynomials


def _wrong(first: int) -> int:
    """Wrong verdicts of `_CHUNK` random polynomials with margins from 1e-2 down to 1e-9."""
    wrong = 0
    for seed in range(first, first + _CHUNK):
        rng = np.random.default_rng(seed)
        force = rng.normal(0.0, rng.uniform(1.0, 8.0), (3, 13))
        force[2] += 9.81
        poly = bernstein.product(force, force).sum(axis=0)
        attained, _, _ = bounds.maximum(poly, 1e-13 * np.abs(poly).max(), -np.inf)
        bound = attained * (1.0 + rng.choice([-1.0, 1.0]) * 10.0 ** rng.uniform(-9.0, -2.0))
        verdict, _ = bounds.stays_below(poly, bound)
        wrong += (verdict == bounds.BELOW) != exact_sturm.stays_below(poly.tolist(), bound)
    return wrong


def wrong_verdicts(count: int) -> float:
    """Verdicts on `count` polynomials, a multiple of 100, that the exact chain contradicts; on all processors but one."""
    starts = range(0, count, _CHUNK)
    found = in_processes(_wrong, starts, max(1, (os.cpu_count() or 1) - 1))
    return float(sum(wrong for _, wrong in counted(found, len(starts), lambda one: not one[1], what=f"times {_CHUNK} verdicts")))
