"""The pad along a flight of the evaluation: what is wrong with the body's pose is wrong with the target's, and does not count."""

import numpy as np
import pytest
from perch_core.vehicle import load_vehicle
from perch_eval import consistency
from perch_eval.estimation_flight import EstimatorTrack, Flight, motion_of
from perch_eval.in_process.modelled_sight import ModelledLocalizer
from perch_eval.perch_motion import ImuReadings
from perch_eval.target_sightings import estimated_body, localize_target
from perch_perception.target_localizer import TargetLocalizerConfig
from perch_sim.scenario import load_scenario
from perch_sim.state_history import StateHistory, TrueState

OFF = np.array([0.02, -0.01, 0.015])


@pytest.fixture(scope="module")
def hover():
    """A flight without images of its own, and its scenario."""
    scenario = load_scenario("surface_90_ideal")
    motion = motion_of(scenario, 3)
    truth = motion.sample(np.arange(0.0, motion.duration - 0.003, 0.02))
    nothing = np.zeros((len(truth.times), 3))
    return scenario, Flight(motion, truth, ImuReadings(nothing, nothing, nothing, nothing), load_vehicle("snapdragon").mounts["down"], ())


def track_of(flight, error=np.zeros(15), sigma=1e-3):
    n = len(flight.truth.times)
    return EstimatorTrack(flight.truth.times, np.tile(error, (n, 1)), np.tile(np.eye(15) * sigma**2, (n, 1, 1)), np.zeros(0))


def test_the_estimated_body_is_the_truth_less_the_error(hover):
    _, flight = hover
    body = estimated_body(flight, track_of(flight, np.r_[OFF, np.zeros(12)]), 3.5)
    np.testing.assert_allclose(flight.motion.sample(np.array([3.5])).p_WB[0] - body.p_WB, OFF, atol=1e-9)


@pytest.mark.slow
def test_errors_of_the_body_move_vehicle_and_target_alike(hover):
    scenario, flight = hover
    exact = localize_target(scenario, flight, track_of(flight), 3, 3.5, 3.8)
    wrong = localize_target(scenario, flight, track_of(flight, np.r_[OFF, np.zeros(12)], sigma=0.015), 3, 3.5, 3.8)
    assert np.isfinite(exact.errors).all() and len(exact.times) == 9
    assert np.linalg.norm(exact.errors[:, :3], axis=1).max() < 0.01
    np.testing.assert_allclose(wrong.errors[:, :3], exact.errors[:, :3], atol=2e-3)
    assert consistency.nees(wrong.errors, wrong.covariances).max() < 16.8  # 99 % of chi2 with 6 degrees of freedom


def test_an_image_from_before_the_truth_was_heard_first_shows_nothing():
    truth = StateHistory(10)
    truth.append(TrueState(1_490_000_000, np.r_[np.zeros(3), 0.0, 0.0, 0.0, 1.0, np.zeros(6)]))
    sight = ModelledLocalizer(TargetLocalizerConfig(), load_scenario("surface_90_ideal"), 1, truth, lambda: None)
    found = sight.process(None, 1.148, None)
    assert found.board is None and "outside" in found.message
