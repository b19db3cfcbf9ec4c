"""Consistency of estimators over Monte-Carlo runs: NEES and NIS with their chi-square bounds.

For a consistent filter of n dimensions, e^T P^-1 e is chi-square with n degrees of freedom, and its mean over N independent
runs lies with probability 95 % in [chi2(0.025; N n), chi2(0.975; N n)] / N at each time (Bar-Shalom).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from perch_core import so3
from perch_core.probability import chi2_quantile

PROBABILITIES = np.array([0.025, 0.975])  # of the bounds


def nees(errors: np.ndarray, covariances: np.ndarray) -> np.ndarray:
    """Normalised estimation error squared, e^T P^-1 e.

    Args:
        errors: shape (..., n).
        covariances: shape (..., n, n).

    Returns:
        Shape (...).
    """
    errors = np.asarray(errors, float)
    return np.einsum("...i,...i->...", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


def attitude_error(q_true: np.ndarray, q_estimate: np.ndarray) -> np.ndarray:
    """Rotation vector in B that takes the estimate to the truth, q_true = q_estimate exp(e), shapes (..., 4) -> (..., 3)."""
    return so3.quat_log(so3.quat_multiply(so3.quat_conjugate(q_estimate), q_true))


@dataclass(frozen=True)
class Consistency:
    """NEES (or NIS) averaged over runs, against its bounds.

    Attributes:
        name: what was tested.
        dimension: degrees of freedom of one sample.
        times: shape (m,) [s].
        mean: average over the runs at each time, shape (m,).
        bounds: 95 % bounds of the average for a consistent filter at each time, shape (2, m).
        runs: number of runs.
        samples_inside: share of the single samples inside the 95 % bounds of one sample.
    """

    name: str
    dimension: int
    times: np.ndarray
    mean: np.ndarray
    bounds: np.ndarray
    runs: int
    samples_inside: float

    @property
    def inside(self) -> float:
        """Share of the time in which the average lies between its bounds."""
        return float(np.mean((self.mean >= self.bounds[0]) & (self.mean <= self.bounds[1])))

    @property
    def above(self) -> float:
        """Share of the time in which the average exceeds its upper bound: the filter is overconfident."""
        return float(np.mean(self.mean > self.bounds[1]))


def judge(name: str, times: np.ndarray, samples: np.ndarray, dimension: int) -> Consistency:
    """Average NEES or NIS samples over runs and compare them with their 95 % bounds.

    Args:
        name, times, dimension: as in `Consistency`.
        samples: shape (runs, m); NaN where a run has none. Times at which less than half of the runs have one are left out.

    Raises:
        ValueError: the shapes do not match.
    """
    samples = np.asarray(samples, float)
    if samples.ndim != 2 or samples.shape[1] != len(times):
        raise ValueError(f"samples of shape {samples.shape} do not fit {len(times)} times")
    counts = np.isfinite(samples).sum(axis=0)
    used = 2 * counts >= max(len(samples), 1)
    samples, counts = samples[:, used], counts[used]
    low, high = np.array([chi2_quantile(PROBABILITIES, n * dimension) / n for n in (1, *counts.tolist())]).reshape(-1, 2).T
    single = samples[np.isfinite(samples)]
    return Consistency(name, dimension, np.asarray(times)[used], np.nanmean(samples, axis=0), np.stack([low[1:], high[1:]]), len(samples),
                       float(np.mean((single >= low[0]) & (single <= high[0]))) if len(single) else np.nan)


def plot(results: list[Consistency], path: Path, marks: dict[str, float]) -> None:
    """Plot each result into an image file, one panel each in two columns: average over the runs, expectation and bounds.

    Args:
        results: what `judge` returned.
        path: file to write (png, svg, pdf).
        marks: name -> time [s] of moments to mark.
    """
    from matplotlib.figure import Figure

    rows = -(-len(results) // 2)
    figure = Figure(figsize=(11.0, 2.3 * rows + 0.5), layout="constrained")
    panels = figure.subplots(rows, 2, sharex=True, squeeze=False)
    for axes in panels.flat[len(results):]:
        axes.axis("off")
    for axes, result in zip(panels.flat, results):
        axes.fill_between(result.times, *result.bounds, color="0.88", lw=0.0)
        axes.axhline(result.dimension, color="0.5", lw=0.8)
        axes.plot(result.times, result.mean, lw=1.0)
        for name, time in marks.items():
            axes.axvline(time, color="C3", lw=0.8, ls=":")
            axes.annotate(name, (time, 0.98), xycoords=("data", "axes fraction"), va="top", fontsize=7, color="C3")
        axes.set_title(f"{result.name}: {100 * result.inside:.0f} % of the time inside, {result.runs} runs", fontsize=9)
        axes.set_ylabel("NEES, mean", fontsize=8)
        axes.set_ylim(0, max(2.5 * result.dimension, 1.1 * float(np.nanpercentile(result.mean, 98))))
    for axes in panels[-1]:
        axes.set_xlabel("time [s]")
    figure.savefig(path, dpi=130)
