"""What the report says about deadlines, from recorded diagnostics."""

from perch_core.component import Diagnostics
from perch_eval.flight import Flight
from perch_eval.metrics import missed_deadlines, node_durations
from perch_eval.report import last_diagnostics


def flight(*reports):
    """A flight of diagnostics: (node, values) in order."""
    return Flight({"diagnostics": [(float(k), Diagnostics(k, {"node": f"/{node}", **{key: str(v) for key, v in values.items()}}))
                                   for k, (node, values) in enumerate(reports)]})


def test_the_last_counts_of_each_node_are_reported():
    flown = flight(("controller", {"deadlines": 500, "missed_deadlines": 9}), ("vehicle", {"steps": 500}),
                   ("controller", {"deadlines": 4000, "missed_deadlines": 10}), ("estimator", {"deadlines": 0, "missed_deadlines": 0}))
    assert missed_deadlines(flown) == {"controller": {"deadlines": 4000.0, "missed": 10.0, "missed_percent": 0.25}}


def test_lockstep_has_no_deadlines():
    assert missed_deadlines(flight(("controller", {"steps": 500, "step_us_median": 80.0}))) == {}


def test_durations_are_medians_in_milliseconds_whatever_their_unit():
    flown = flight(*(("vio", {"image_ms": v, "step_us_median": 1000 * v, "state": "running"}) for v in (9.0, 2.0, 3.0)))
    assert node_durations(flown) == {"vio": {"image_ms": 3.0, "step_ms_median": 3.0}}


def test_the_last_diagnostics_leave_durations_to_the_other_table():
    flown = flight(("vio", {"tracks": 10, "step_us_p99": 12.5}), ("vio", {"tracks": 40, "step_us_p99": 12.5, "image_ms": 3.0, "clock_offset_s": 0.25}))
    assert last_diagnostics(flown) == [("vio", "tracks 40, clock offset 0.25 s")]


def test_the_last_diagnostics_have_whole_numbers_and_no_second_real_time_factor_and_no_empty_rows():
    flown = flight(("vehicle", {"time_s": 6.874, "steps": 14210, "real_time_factor": 0.6775, "steps_per_s": 257.252}), ("mission", {"step_us_p99": 577.8}))
    assert last_diagnostics(flown) == [("vehicle", "steps 14210, steps 257.3 per s")]
