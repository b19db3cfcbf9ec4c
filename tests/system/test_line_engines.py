"""A perch on a cable by both engines: mapped, planned, re-planned on the way, gripped; the same flight to the last bit."""

import os

import pytest

from perch_eval.demo import fly as fly_on_the_stack
from perch_eval.in_process import Sensing, fly
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_sim.contact_event import ContactState
from perch_sim.scenario import load_scenario

pytestmark = pytest.mark.skipif(os.environ.get("PERCH_SLOW") != "1", reason="two powerline flights, minutes: set PERCH_SLOW=1")


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    report = fly_on_the_stack("line_20", 1, folder)
    return report, RecordedFlight(folder / "flight.mcap"), fly(load_scenario("line_20"), 1, Sensing(vio="rendered", target="rendered"), linger=0.2)


def test_the_same_flight(flights):
    report, recorded, trace = flights
    assert (report["outcome"], report["message"]) == (trace.outcome, trace.message)
    assert recorded.digest(trace.end_time) == trace.flight.digest(trace.end_time)


def test_plans_follow_the_map_and_no_other_line_is_touched(flights):
    _, recorded, trace = flights
    plans = [order.id for order in trace.values("trajectory") if order.recovery_start > 0.0]
    assert len(plans) > 1, "planned again on the way"
    assert [order.id for _, order in recorded.values("trajectory") if order.recovery_start > 0.0] == plans
    touched = [c for c in trace.contacts if c.body.startswith("cable")]
    assert [(ContactState(c.state).name, c.body) for c in touched] == [("ATTACHED", "cable 2")]
