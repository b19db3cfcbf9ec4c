"""The map without images: where it places cables, seen from the vehicle."""

import numpy as np
import pytest
from perch_core.values import CameraModel, OdometryState
from perch_core.vehicle import load_vehicle
from perch_eval.in_process.modelled_sight import MapParameters, ModelledLocalizer, ModelledMap
from perch_perception.target_localizer import TargetLocalizerConfig
from perch_sim.scenario import load_scenario
from perch_sim.state_history import StateHistory, TrueState

LINE = load_scenario("line_80")
NEAR = np.array([4.0, 0.0, 4.25])  # a point of the first cable, which runs along y
FRONT = load_vehicle("rpg").mounts["front"].camera
COVARIANCE = np.diag([1e-4] * 3 + [1e-6] * 3)
FORWARD, BACKWARD = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 1.0, 0.0)


class Flight:
    """A vehicle at rest at given places, with an estimate that is off by a given drift."""

    def __init__(self, seed, scenario=LINE):
        self.map, self.maps, self.time = ModelledMap(MapParameters(seed=seed), scenario), [], 1_000_000_000
        self.map.powerlines.receivers.append(self.maps.append)

    def look(self, place, drift=np.zeros(3), attitude=FORWARD):
        """Return the first cable's mapped place beside the vehicle, relative to the estimate, and its covariance; None: not mapped."""
        for _ in range(60):  # 0.12 s at 500 Hz: a frame is used, and the estimate has no gap
            for on, p in ((self.map.on_truth, place), (self.map.on_odometry, place + drift)):
                on(OdometryState(self.time, tuple(p.tolist()), attitude, (0.0,) * 3, (0.0,) * 3, COVARIANCE, COVARIANCE))
            self.time += 2_000_000
        self.map.on_camera_info(CameraModel(self.time - 30_000_000, "front_camera_optical_frame", FRONT))
        first = next((line for line in self.maps[-1].lines if line.id == 0), None)
        return None if first is None else (first.segment.closest_point(place + drift) - place - drift, np.reshape(first.covariance, (3, 3)))


def errors(distance, drift=np.zeros(3), seeds=40):
    """Errors across the first cable of its place relative to the vehicle, (n, 2) [m], and in sigmas, (n,) squared over 2."""
    place, found = NEAR - [distance, 0.0, 0.0], []
    for seed in range(seeds):
        mapped, covariance = Flight(seed).look(place, drift)
        off = (mapped - (NEAR - place))[[0, 2]]
        found.append((*off, off @ np.linalg.solve(covariance[np.ix_([0, 2], [0, 2])], off) / 2.0))
    return np.array(found)


def test_the_map_is_right_relative_to_the_estimate_however_far_it_has_drifted():
    assert np.abs(errors(0.3, np.array([0.3, 0.0, -0.2]), seeds=10)[:, :2]).max() < 0.03


def test_its_error_grows_with_the_distance_as_its_covariance_says():
    at = {distance: errors(distance) for distance in (0.3, 2.2, 4.0)}
    depth, across = ({distance: float(np.sqrt(np.mean(found[:, k] ** 2))) for distance, found in at.items()} for k in (0, 1))
    assert depth[0.3] < 0.01 < depth[2.2] < 0.04 and 0.03 < depth[4.0] < 0.07
    assert across[0.3] < across[2.2] < depth[2.2] and across[4.0] < depth[4.0]
    assert all(0.6 < np.mean(found[:, 2]) < 1.5 for found in at.values())


def test_a_cable_out_of_view_stays_where_it_was_while_the_estimate_drifts():
    flight, place, drift = Flight(1), NEAR - [2.0, 0.0, 0.0], np.array([0.05, 0.0, 0.03])
    assert flight.look(place, attitude=BACKWARD) is None
    seen = flight.look(place)[0]
    np.testing.assert_allclose(flight.look(place, drift, BACKWARD)[0], seen - drift, atol=3e-3)
    np.testing.assert_allclose(flight.look(place, drift)[0], seen, atol=3e-3)


def test_a_seed_repeats():
    assert Flight(3).look(NEAR - [2.0, 0.0, 0.0])[0] == pytest.approx(Flight(3).look(NEAR - [2.0, 0.0, 0.0])[0], abs=0.0)


def test_an_image_from_before_the_truth_was_heard_first_shows_nothing():
    truth = StateHistory(10)
    truth.append(TrueState(1_490_000_000, np.r_[np.zeros(3), 0.0, 0.0, 0.0, 1.0, np.zeros(6)]))
    sight = ModelledLocalizer(TargetLocalizerConfig(), load_scenario("surface_90_ideal"), 1, truth, lambda: None)
    found = sight.process(None, 1.148, None)
    assert found.board is None and "outside" in found.message
