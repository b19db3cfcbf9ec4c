"""The flight loop: its first moments, what is disturbed on its way, and what is recorded."""

from dataclasses import replace

import pytest

from perch_core.errors import PerchError
from perch_eval.in_process import Sensing, arrange, fly
from perch_eval.in_process.flights import perch
from closed_loop.truth import TruthEstimator
from perch_eval.metrics import flight_metrics
from perch_eval.ros.recorded_flight import RecordedFlight, write
from perch_sim.scenario import load_scenario
from perch_sim.simulation import START


@pytest.fixture(scope="module")
def flown():
    """A flight of seed 2."""
    return fly(load_scenario("surface_90"), 2)


def test_an_image_exposed_before_the_first_step_ends_is_looked_at():
    loop = arrange(load_scenario("surface_90_far"), 77, replace={"estimator": TruthEstimator()})
    first = loop.step()
    for _ in range(30):
        loop.step()
    assert START < loop.trace.values("target/detections")[0].stamp < first


def test_a_flight_without_vio_does_not_take_off():
    loop = arrange(load_scenario("surface_90"), 1)
    for channel in ("vio/state", "vio/odometry"):
        loop.filters["estimator", channel] = lambda now, value: None
    scenario = replace(load_scenario("surface_90"), time_limit=8.0)
    trace = perch(loop, scenario)
    assert trace.outcome == "timeout" and trace.end_time > 1e-9 * START + scenario.time_limit
    assert trace.values("vio/state") and not trace.values("odometry")
    assert max(truth.p_WB[2] for truth in trace.values("ground_truth/odometry")) < 0.2


def test_a_flight_that_breaks_is_closed(monkeypatch):
    loop, closed = arrange(load_scenario("surface_90"), 1), []
    monkeypatch.setattr(loop, "step", lambda: 1 // 0)
    monkeypatch.setattr(loop.vehicle, "close", lambda: closed.append("vehicle"))
    with pytest.raises(ZeroDivisionError):
        perch(loop, load_scenario("surface_90"))
    assert closed == ["vehicle"]


def test_a_component_is_replaced_by_its_name():
    scenario = load_scenario("surface_90")
    trace = perch(arrange(scenario, 1, replace={"estimator": TruthEstimator()}), scenario)
    assert trace.outcome == "perched"
    assert [e.p_WB for e in trace.values("odometry")] == [t.p_WB for t in trace.values("ground_truth/odometry")]


@pytest.mark.parametrize("given, rendered", [("all", {"down", "front"}), ("down", {"down"}), ("none", set())])
def test_a_scenarios_parameters_of_the_vehicle_are_those_of_its_node(given, rendered):
    scenario = replace(load_scenario("surface_90"), parameters={"vehicle": {"cameras": given}})
    loop = arrange(scenario, 1, Sensing("rendered", "rendered"), without=("vio", "target_localizer", "mission", "perching_planner"))
    arrivals = [arrival for _ in range(60) for arrival in loop.vehicle.advance()]
    loop.close()
    assert {arrival.camera for arrival in arrivals if arrival.image is not None} == rendered


def test_another_seed_is_another_flight(flown):
    """That the same seed is the same flight is shown in `test_goals_in_a_row.py`, and across processes in `tests/system`."""
    other = arrange(load_scenario("surface_90"), 3)
    while other.time < 1.5:
        other.step()
    assert other.trace.flight.digest(other.time) != flown.flight.digest(other.time)
    assert [phase for _, phase, _ in flown.phases] == [
        "arming", "arming", "take_off", "searching", "searching", "planning", "tracking", "verifying", "perched"]


def test_a_recording_of_a_flight_has_its_digest_and_its_figures(flown, tmp_path):
    write(tmp_path / "flight.mcap", flown.timeline())
    recorded = RecordedFlight(tmp_path / "flight.mcap")
    assert recorded.digest(flown.end_time) == flown.flight.digest(flown.end_time)
    assert flight_metrics(recorded, flown.end_time) == flight_metrics(flown.flight, flown.end_time)


def test_what_has_no_error_model_is_refused():
    line = load_scenario("line_180")
    hanging = replace(line, world=replace(line.world, cables=tuple(replace(cable, sag=0.5) for cable in line.world.cables)))
    with pytest.raises(PerchError, match="sag have no error model"):
        fly(hanging, 1)
    with pytest.raises(PerchError, match="sensing.vio: 'real' is not one of model, rendered"):
        Sensing(vio="real")
