"""Both engines fly the same flight, cameras rendered, VIO and tags at work.

What transport rounds (a velocity goes through the vehicle's axes and back) the in-process engine rounds too, so that images
and their tracking, which amplify the last bit, are the same. The tolerance leaves room for another machine's mathematics.
"""

import numpy as np
import pytest

from perch_core.scenario import load_scenario
from perch_eval.demo import fly as fly_on_the_stack
from perch_eval.flight import Flight
from perch_eval.in_process import Sensing, fly
from perch_eval.in_process.trace import ESTIMATE, TRUTH

TOLERANCE = 1e-7  # [m], [m/s], [rad/s] and components of quaternions

SCENARIO = """
name: both_engines
description: gusts, a turned surface and a heavier vehicle, so that nothing is zero by symmetry
target: {inclination_deg: 75.0, distance: 1.6, height: 1.2, turn_deg: 8.0}
wind: {steady: [0.1, 0.2, 0.0], gust_sigma: 0.1}
disturbance: {mass_factor: 1.02}
nodes: [vehicle, vio, estimator, target_localizer, perching_planner, controller, mission]
"""


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("engines")
    file = folder / "both_engines.yaml"
    file.write_text(SCENARIO)
    report = fly_on_the_stack(str(file), 5, folder / "stack")
    trace = fly(load_scenario(file), 5, Sensing(vio="rendered", target="rendered"))
    return report, Flight(folder / "stack" / "flight.mcap"), trace


def test_the_same_flight_up_to_transport(flights):
    _, recorded, trace = flights
    steps = len(trace.stamps)
    assert steps > 2000
    for topic, part in (("ground_truth/odometry", TRUTH), ("odometry", ESTIMATE)):
        states, rows = recorded.states(topic), trace.part(part)
        assert np.allclose(states.t[:steps], trace.times, atol=1e-9, rtol=0)
        for name, columns in (("p", slice(0, 3)), ("q", slice(3, 7)), ("v", slice(7, 10)), ("w", slice(10, 13))):
            worst = np.abs(getattr(states, name)[:steps] - rows[:, columns]).max()
            assert worst < TOLERANCE, f"{topic}.{name} differs by {worst:.2e}"


def test_the_same_end_and_the_same_events(flights):
    report, recorded, trace = flights
    assert (report["outcome"], report["message"]) == (trace.outcome, trace.message)
    assert report["simulated_time_s"] == pytest.approx(trace.end_time, abs=1e-6)
    touched = [(round(t, 6), m.state, m.body) for t, m in recorded.messages("contact") if t <= trace.end_time]
    assert touched == [(round(c.time, 6), int(c.state), c.body) for c in trace.contacts]
    plans = [m for t, m in recorded.messages("trajectory") if t <= trace.end_time]
    assert [m.id for m in plans] == [flown.id for _, flown in trace.trajectories]


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not(flights, tmp_path):
    scenario = load_scenario("surface_90")
    first, again, other = (fly(scenario, seed) for seed in (2, 2, 3))
    assert first.states == again.states and first.motors == again.motors
    assert first.states != other.states
