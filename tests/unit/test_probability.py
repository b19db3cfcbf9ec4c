"""Quantiles and tails against scipy's distributions, to the last bit."""

from __future__ import annotations

import numpy as np
import pytest
from perch_core.probability import binomial_tail, chi2_quantile
from scipy.stats import binom, chi2


@pytest.mark.parametrize("probability", [0.05, 0.5, 0.99, 0.999999])
def test_quantiles_of_chi2(probability):
    freedom = np.arange(1, 400)
    np.testing.assert_array_equal(chi2_quantile(probability, freedom), chi2.ppf(probability, freedom))


@pytest.mark.parametrize("count", [1, 7, 160])
@pytest.mark.parametrize("probability", [0.02, 0.4, 1.0])
def test_tails_of_the_binomial(count, probability):
    for least in range(1, count + 2):
        assert binomial_tail(least, count, probability) == binom.sf(least - 1, count, probability)
