"""Quantiles and tail probabilities. `scipy.stats` has the same functions, but its import takes half of a node's start-up time."""

from __future__ import annotations

import numpy as np
from scipy.special import betainc, gammaincinv


def chi2_quantile(probability: float | np.ndarray, freedom: float | np.ndarray) -> np.ndarray:
    """Quantile of the chi-squared distribution.

    Args:
        probability: in [0, 1], broadcast with `freedom`.
        freedom: degrees of freedom, > 0.
    """
    return np.asarray(2.0 * gammaincinv(0.5 * np.asarray(freedom), probability))


def binomial_tail(least: int, count: int, probability: float) -> float:
    """Probability that at least `least` >= 1 of `count` independent trials succeed, each with the given probability."""
    return float(betainc(least, count - least + 1, probability)) if least <= count else 0.0
