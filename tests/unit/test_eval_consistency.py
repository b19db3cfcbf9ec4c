"""Consistency of the estimators from flights: NEES against its bounds, by the time from the planned start of the perch."""

import math

import numpy as np
import pytest
from perch_core import so3
from perch_core.trajectory import rest_to_rest
from perch_core.values import AtEnd, Contact, OdometryState, PoseStamped, TargetPose, TrajectoryOrder, rotated
from perch_eval import consistency
from perch_eval.evaluation import consistency as part
from perch_eval.evaluation.document import Effort
from perch_eval.flight import Flight, timed
from perch_perception.ukf import Estimate
from perch_perception.vio.start import CONFIGURED_POSE_SIGMA
from scipy.stats import chi2

ZERO, WALL, START = np.zeros((6, 6)), np.array([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)]), np.array([0.0, 0.0, 1.0])


def drawn(rng, q, P):
    """An attitude whose error about the axes of W, truth relative to estimate, has the covariance P; and the position's error."""
    e = rng.multivariate_normal(np.zeros(6), P)
    return so3.quat_multiply(so3.quat_conjugate(so3.quat_exp(e[3:])), q), e[:3]


def judged(seed, begin, shift=np.zeros(3), scale=1.0, off=np.zeros(4), start=np.zeros(4)):
    """NEES of a flight that turns while it moves, with errors drawn from their covariances, times `scale`; a perch is planned at `begin`.

    `off`: position and heading of the estimators' start relative to the true one. `start`: with which `history` is called.
    """
    rng = np.random.default_rng(seed)
    path = rest_to_rest(START, [2.0, 0.0, 1.0], 0.0, 0.0, 2.0, start_time=begin)
    P, P_states = np.diag(np.linspace(0.5, 2.0, 6)) * 1e-6, np.diag(np.linspace(0.5, 2.0, 15)) * 1e-6
    truth, estimates, vio, target, states, biases = [], [], [], [], [], []
    for k in range(500, round(500 * (begin + 2.2))):
        stamp, sample = 2_000_000 * k, path.sample(min(max(0.002 * k - begin, 0.0), 2.0))
        q = so3.quat_exp(np.array([0.0, 0.4 * math.sin(0.006 * k), 0.0]))
        v_B = rotated(tuple(q), tuple(sample.v), -1.0)

        def odometry(p, q, covariance=ZERO):
            return OdometryState(stamp, tuple(p), tuple(q), v_B, (0.0,) * 3, covariance, ZERO)

        truth.append(odometry(sample.p, q))
        turn = so3.quat_exp(np.array([0.0, 0.0, off[3]]))
        p_there = START + off[:3] + rotated(turn, sample.p - START, 1.0)
        v_there, q_there = np.array(rotated(turn, sample.v, 1.0)), so3.quat_multiply(turn, q)
        estimates.append(odometry(sample.p + shift, q))
        if k % 5 == 0:
            e = rng.multivariate_normal(np.zeros(15), P_states) * scale
            states.append(Estimate(stamp, p_there - e[:3], v_there - e[3:6], so3.quat_multiply(q_there, so3.quat_exp(-e[6:9])), np.zeros(3), -e[9:12], -e[12:],
                                   P_states))
            biases.append(np.zeros(6))
        if k % 17 == 0:
            q_vio, e = drawn(rng, q_there, P)
            vio.append(odometry(p_there - e, q_vio, P))
            q_target, e = drawn(rng, WALL, P)
            target.append(TargetPose(stamp, np.array([3.0, 0.0, 1.0]) + shift - e, q_target, P))
    channels = {"ground_truth/odometry": truth, "odometry": estimates, "vio/odometry": vio, "target/pose": target,
                "ground_truth/target": [PoseStamped(0, (3.0, 0.0, 1.0), tuple(WALL))], "contact": [Contact(1_100_000_000, 0, "ground", 0.0, 0.0, 0.0, 0.0, "")],
                "trajectory": [TrajectoryOrder(1, path, AtEnd.CONTACT, 0.25)]}
    return part.history(Flight({name: timed(values) for name, values in channels.items()}), states, biases, start)


@pytest.mark.slow
def test_errors_as_large_as_their_covariances_have_a_nees_of_one_per_dimension_and_larger_ones_do_not():
    """With perches planned at different times, an odometry that is off, and a vehicle that turns."""
    runs = [judged(seed, 2.5 + 0.1 * seed, shift=0.05 * np.ones(3)) for seed in range(3)]
    for name, dimension in part.DIMENSIONS.items():
        samples = np.array([run[name] for run in runs], float)
        found = consistency.judge(name, part.TIMES, samples, dimension)
        assert len(found.times) > 60 and found.mean.mean() / dimension == pytest.approx(1.0, abs=0.15), name
        assert 0.85 < found.inside and 0.9 < found.samples_inside < 0.99, name
    assert np.nanmean(np.array(judged(0, 2.5, scale=2.0)[part.STATES], float)) > 50.0


def test_an_error_of_the_start_counts_as_one_of_the_estimators_and_not_of_the_targets():
    """With the vehicle's start in the wrong place and direction, the errors are those of estimators that are there."""
    off = np.array([0.2, -0.1, 0.05, 0.01])
    right, wrong, moved = judged(1, 2.5), judged(1, 2.5, start=off), judged(1, 2.5, off=off, start=off)
    for name, dimension in part.DIMENSIONS.items():
        at_the_start, elsewhere, there = (np.array(run[name], float) for run in (right, wrong, moved))
        np.testing.assert_allclose(there, at_the_start, rtol=0.1, atol=0.05 * dimension)
        if name.startswith("target"):
            np.testing.assert_array_equal(elsewhere, at_the_start)
        elif "velocity" not in name:  # that of a vehicle at rest has no direction
            assert np.nanmin(elsewhere) > 5.0 * dimension


def test_the_start_is_as_wrong_as_vio_takes_it_to_be():
    drawn_errors = np.array([part.start_error(seed) for seed in range(400)])
    np.testing.assert_allclose(drawn_errors.std(axis=0), CONFIGURED_POSE_SIGMA, rtol=0.15)
    np.testing.assert_array_equal(part.start_error(3), drawn_errors[3])


def test_only_times_in_the_air_count_and_flights_without_a_planned_perch_do_not():
    run = np.array(judged(1, 3.0)[part.STATES], float)
    begin, end = part.TIMES[np.isfinite(run)][[0, -1]]
    assert begin == pytest.approx(1.1 + part.AIRBORNE_AFTER - 3.0, abs=0.04) and end == pytest.approx(2.0, abs=0.04)
    assert part.history(Flight({"ground_truth/odometry": []}), [], [], np.zeros(4)) == {}


@pytest.mark.slow
def test_a_flight_with_rendered_images_is_judged_by_its_true_states_and_biases():
    """Its NEES is within what single samples of a consistent filter have; against biases of the other sensor, it would be far above."""
    row = part._fly_seed(1)
    assert row["cause"] == "perched" and 0.0 < row["metrics"]["nis_estimator"] < 2.0 and 0.1 < row["metrics"]["nis_vio"] < 2.0, row["message"]
    for name, dimension in part.DIMENSIONS.items():
        samples = np.array(row["history"][name], float)
        assert np.isfinite(samples).sum() > 90 and 0.05 * dimension < np.nanmean(samples) < chi2.ppf(0.99, dimension), name


@pytest.mark.slow
def test_the_page_has_the_claim_on_the_mean_and_the_share_of_single_samples(tmp_path, monkeypatch):
    """Rows as they are read from the file of finished flights."""
    rng = np.random.default_rng(3)
    metrics = {**{f"estimation_rmse_m_{axis}": 0.005 for axis in "xyz"}, "nis_estimator": 0.5, "nis_vio": 0.25}

    def flown(effort, name, seeds, *arguments, **options):
        return [{"number": seed, "seed": seed, "cause": "perched", "outcome": "perched", "message": "", "metrics": metrics, "history": {
            name: [None, *rng.chisquare(n, len(part.TIMES) - 1).tolist()] for name, n in part.DIMENSIONS.items()} if seed < 20 else {}} for seed in seeds]

    monkeypatch.setattr(part, "cached_figures", flown)
    effort = Effort(False, 1, tmp_path, tmp_path, "", range(1, 21), range(1), 1, {"commit": "1234567", "digest": ""})
    [section] = part.consistency_sections(effort)
    rows = {row.name: row for row in section.rows}
    assert rows[part.STATES].verdict == "holds" and "19 of 20 flights planned one" in section.about
    assert rows["estimator: all 15 states, single samples"].ours in ("94 % inside", "95 % inside", "96 % inside")
    assert rows["RMSE of x, y, z through the perch"].ours == "0.50, 0.50, 0.50 cm" and rows["NIS of VIO over its dimension"].ours == "0.25"
    assert (tmp_path / "consistency.png").exists()
    monkeypatch.setattr(part, "cached_figures", lambda *arguments, **options: [])
    assert part.consistency_sections(effort)[0].rows[0].verdict == "not available"


def test_parts_without_a_time_at_which_half_of_the_flights_have_a_sample_are_reported_as_missing(tmp_path, monkeypatch):
    def flown(effort, name, seeds, *arguments, **options):
        metrics = dict.fromkeys((*part.RMSE, *part.NIS), 1.0)
        return [{"number": seed, "seed": seed, "cause": "perched", "outcome": "perched", "message": "", "metrics": metrics, "history": {
            name: [1.0 if k % 3 == seed else None for k in range(len(part.TIMES))] for name in part.DIMENSIONS}} for seed in range(3)]

    monkeypatch.setattr(part, "cached_figures", flown)
    [section] = part.consistency_sections(Effort(False, 1, tmp_path, tmp_path, "", range(3), range(1), 1, {"commit": "1234567", "digest": ""}))
    assert [row.verdict for row in section.rows if row.name in part.DIMENSIONS] == ["not available"] * len(part.DIMENSIONS)
    assert not section.figures
