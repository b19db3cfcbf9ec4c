"""What a covariance says in one number."""

from __future__ import annotations

import numpy as np


def largest_sigma(covariance: np.ndarray) -> float:
    """Standard deviation along the worst axis: the root of the largest eigenvalue, in the root of the covariance's unit.

    Args:
        covariance: symmetric, shape (n, n); one that rounding has made slightly negative counts as zero.
    """
    return float(np.sqrt(max(0.0, np.linalg.eigvalsh(covariance)[-1])))
