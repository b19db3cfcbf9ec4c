"""When an answer in real time is late: against a made-up clock."""

import numpy as np
import pytest

from perch_core.ros.deadlines import LATE_IN_A_ROW_MAX, WINDOW, Deadlines, durations_us, median_and_p99
from perch_sim.timing import CONTROL_PERIOD_NS as PERIOD

START = 1_000_000_000  # stamp of the first step [ns]
AHEAD = 77_000_000_000  # of the monotonic clock, unknown to the node [ns]


def answer(deadlines, steps, delay=lambda k: 0):
    for k in steps:
        deadlines.record_answer(START + k * PERIOD, START + AHEAD + k * PERIOD + delay(k))
    return deadlines.report()


def test_a_steady_delay_is_no_miss():
    report = answer(Deadlines(), range(2000), lambda k: 5 * PERIOD)
    assert (report["deadlines"], report["missed_deadlines"], report["delay_us_p99"]) == (2000, 0, 0.0)


def test_answers_later_than_a_period_are_missed_and_those_below_are_not():
    late = {300: PERIOD + 1, 700: 3 * PERIOD, 900: PERIOD, 1100: PERIOD // 2}
    assert answer(Deadlines(), range(1500), lambda k: late.get(k, 0))["missed_deadlines"] == 2


def test_steps_without_an_answer_are_missed():
    deadlines = Deadlines()
    answer(deadlines, range(100))
    report = answer(deadlines, range(103, 200))
    assert (report["deadlines"], report["missed_deadlines"]) == (200, 3)


def test_a_vehicle_that_gives_up_time_is_on_time_again_soon():
    """Its stamps stay behind the wall clock for good; so many answers are missed, and a late one among those that follow."""
    late = {2 * WINDOW + 10 * LATE_IN_A_ROW_MAX: 3 * PERIOD}
    report = answer(Deadlines(), range(10 * WINDOW), lambda k: (50 * PERIOD if k >= 2 * WINDOW else 0) + late.get(k, 0))
    assert report["missed_deadlines"] == LATE_IN_A_ROW_MAX + 1


def test_a_burst_that_is_caught_up_counts_all_its_late_answers():
    """25 steps behind, one less at every answer: the last but one is a period late no more."""
    report = answer(Deadlines(), range(2000), lambda k: max(0, 25 - (k - 1000)) * PERIOD if k >= 1000 else 0)
    assert report["missed_deadlines"] == 24


def test_the_delay_is_that_of_the_last_second():
    delays = np.random.default_rng(1).uniform(0, 1e6, 5000).astype(int)
    report = answer(Deadlines(), range(5000), lambda k: int(delays[k]))
    expected = np.percentile(delays[-WINDOW:], 99) - delays[-2 * WINDOW:].min()
    assert abs(1e3 * report["delay_us_p99"] - expected) < 3e4


def test_median_and_p99_are_samples_next_to_the_quantiles():
    samples = np.random.default_rng(3).exponential(size=500)
    for ours, share in zip(median_and_p99(samples), (0.5, 0.99)):
        assert ours in samples
        assert np.quantile(samples, share - 0.002) <= ours <= np.quantile(samples, share + 0.002)
    assert median_and_p99([7.0]) == (7.0, 7.0)


def test_durations_are_reported_in_microseconds_and_none_without_any():
    assert durations_us("step", [0.002, 0.001, 0.003]) == {"step_us_median": 2000.0, "step_us_p99": 2000.0}
    assert durations_us("step", []) == {}


@pytest.mark.parametrize("period", [1_000_000, 5_000_000, 10_000_000])
def test_the_period_is_that_of_the_imu(period):
    deadlines = Deadlines()
    for k in range(1000):
        deadlines.record_answer(k * period, k * period + (0 if k != 700 else period + 1))
    assert (deadlines.answers, deadlines.missed) == (1000, 1)
    deadlines.record_answer(1003 * period, 1003 * period)  # three were never answered
    assert (deadlines.answers, deadlines.missed) == (1004, 4)
