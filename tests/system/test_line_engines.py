"""A perch on a cable by both engines, on the real nodes and without ROS: the same flight to the last bit.

No images are rendered, which would take two minutes of processor time: the map is made from the truth, and stays as it is. That
engines agree on images is shown in `test_flight_surface.py`.
"""

from __future__ import annotations

from contextlib import closing

import pytest
from perch_eval import modelled_sight_node
from perch_eval.domain import domain_in_environment
from perch_eval.in_process import FlightTrace, fly
from perch_eval.nodes import ALL_NODES, node_programs
from perch_eval.ros.mission_client import FlightResult, MissionClient
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.stack import Stack
from perch_sim.contact_event import ContactState
from perch_sim.scenario import load_scenario
from system.scripts import PATIENCE

SCENARIO, SEED, LINGER = "line_20", 1, 0.2


@pytest.fixture(scope="module")
def flights(tmp_path_factory) -> tuple[FlightResult, RecordedFlight, FlightTrace]:
    """Result and recording of a flight on the real nodes, and the same without ROS."""
    folder, scenario = tmp_path_factory.mktemp("line"), load_scenario(SCENARIO)
    overrides = {"mission": {"lockstep_hold": "perch"}, "recorder": {"file": str(folder / "flight.mcap")}}
    launches = modelled_sight_node.imageless_launches(scenario, SEED, SCENARIO, True, extra=("recorder",), overrides=overrides)
    programs = node_programs(launches, folder, composed=set(ALL_NODES) - set(modelled_sight_node.NODES))
    with domain_in_environment(), Stack(modelled_sight_node.imageless_programs(programs), folder) as stack, closing(MissionClient()) as pilot:
        stack.wait_until_ready(pilot.visible_nodes, PATIENCE)
        result = pilot.fly(scenario, check=stack.raise_if_ended, stall_timeout=PATIENCE)
        pilot.linger(LINGER, stack.raise_if_ended, PATIENCE)
    return result, RecordedFlight(folder / "flight.mcap"), fly(scenario, SEED, linger=LINGER)


def test_the_same_flight(flights):
    result, recorded, trace = flights
    assert (result.outcome, result.message) == (trace.outcome, trace.message)
    assert recorded.digest(trace.end_time) == trace.flight.digest(trace.end_time)


def test_the_wire_is_gripped_on_a_plan_with_recovery_and_no_other_line_is_touched(flights):
    result, recorded, trace = flights
    assert result.outcome == "perched"
    plans = [order.id for order in trace.values("trajectory") if order.recovery_start > 0.0]
    assert plans and [order.id for _, order in recorded.values("trajectory") if order.recovery_start > 0.0] == plans
    touched = [c for c in trace.contacts if c.body.startswith("cable")]
    assert [(ContactState(c.state).name, c.body) for c in touched] == [("ATTACHED", "cable 2")]
