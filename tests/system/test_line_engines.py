"""A perch on a cable by both engines: mapped, planned, re-planned on the way, gripped; the same flight to the last bits."""

import os

import numpy as np
import pytest

from perch_core.scenario import load_scenario
from perch_eval.demo import fly as fly_on_the_stack
from perch_eval.flight import Flight
from perch_eval.in_process import Sensing, fly
from perch_eval.in_process.trace import ESTIMATE, TRUTH

TOLERANCE = 1e-7  # as in test_campaign_engines

pytestmark = pytest.mark.skipif(os.environ.get("PERCH_SLOW") != "1", reason="two powerline flights, minutes: set PERCH_SLOW=1")


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    folder = tmp_path_factory.mktemp("line")
    report = fly_on_the_stack("line_20", 1, folder)
    return report, Flight(folder / "flight.mcap"), fly(load_scenario("line_20"), 1, Sensing(vio="rendered", target="rendered"))


def test_the_same_flight(flights):
    report, recorded, trace = flights
    assert (report["outcome"], report["message"]) == (trace.outcome, trace.message)
    steps = len(trace.stamps)
    for topic, part in (("ground_truth/odometry", TRUTH), ("odometry", ESTIMATE)):
        states, rows = recorded.states(topic), trace.part(part)
        for name, columns in (("p", slice(0, 3)), ("q", slice(3, 7)), ("v", slice(7, 10)), ("w", slice(10, 13))):
            assert np.abs(getattr(states, name)[:steps] - rows[:, columns]).max() < TOLERANCE, f"{topic}.{name}"


def test_plans_follow_the_map_and_no_other_line_is_touched(flights):
    _, recorded, trace = flights
    plans = [flown for _, flown in trace.trajectories if flown.recovery_start > 0.0]
    assert len(plans) > 1, "planned again on the way"
    assert [m.id for _, m in recorded.messages("trajectory") if m.recovery_start > 0.0] == [flown.id for flown in plans]
    touched = [c for c in trace.contacts if c.body.startswith("cable")]
    assert [(c.state.name, c.body) for c in touched] == [("ATTACHED", "cable 2")]
