"""Claims of the evaluation fail where flights do: rows that look good for the wrong reason do not hold."""

import dataclasses
from types import SimpleNamespace
from unittest import mock

import numpy as np
import pytest

from perch_core import so3
from perch_core.vehicle import load_vehicle
from perch_eval.campaign.results import RunResult
from perch_eval.evaluation import control, inspection, perching, powerline, ways_out
from perch_eval.evaluation.document import Effort
from perch_eval.inspection.measures import inspection_result, judge, reference_states, segments, watched
from perch_sim.scenario import load_scenario


@pytest.fixture
def effort(tmp_path):
    return Effort(True, 1, tmp_path, tmp_path / "state", "x", range(1, 6), range(1, 2), 3)


def verdicts(section):
    return {row.name: row.verdict.lower() for row in section.rows if row.verdict.lower() != "shown"}


@pytest.mark.parametrize("outcome, verdict", [("good", "holds"), ("crashed", "fails")])
def test_controllers_that_track_well_until_they_crash_fail(effort, monkeypatch, outcome, verdict):
    def rows(effort, name, jobs, work, good):
        return [{"controller": c, "condition": k, "maneuver": m, "seed": seed, "rmse": (0.01,) * 3 if "L1" in c else (0.04,) * 3,
                 "outcome": {"line": "held", "perch": "perched"}[m] if outcome == "good" else outcome} for c, k, m, seed in jobs]

    monkeypatch.setattr(control, "cached_figures", rows)
    assert set(verdicts(control.comparison_sections(effort)[0]).values()) == {verdict}


def test_ways_out_of_plans_that_were_all_refused_fail(effort, monkeypatch):
    def rows(effort, name, jobs, work, good):
        return [] if name == "aborted" else [{"name": name, "seed": seed, "refused": "thrust", "instants": []} for name, seed in jobs]

    monkeypatch.setattr(ways_out, "cached_figures", rows)
    assert set(verdicts(ways_out.sections(effort)[0]).values()) == {"fails"}


@pytest.mark.parametrize("perches, found", [(5, {"holds", "better"}), (4, {"fails", "better"}), (0, {"fails", "worse"})])
def test_errors_of_few_flights_are_not_those_of_all(effort, perches, found):
    metrics = {f"{kind}_rmse_m_{axis}": 0.001 for kind in ("tracking", "estimation") for axis in "xyz"}
    flights = [RunResult(k, k, "perched", "perched", "", metrics=metrics if k < perches else {}) for k in range(5)]
    section = perching._errors(effort, dict.fromkeys(perching.CONDITIONS, flights))
    assert set(verdicts(section).values()) == found
    assert all(f"({perches} of 5 flights)" in row.ours for row in section.rows)


def test_ways_out_of_the_one_plan_that_there_is_are_not_all(effort, monkeypatch):
    def rows(effort, name, jobs, work, good):
        if name == "aborted":
            return [{"scenario": s, "seed": n, "before": t, "planned": True, "end": "never cancelled", "perched": False, "message": "", "rate": 1.0,
                     "margin": 0.1, "distance": 1.0, "settled": 0.1} for s, n, t in jobs]
        return [{"name": name, "seed": seed, "refused": "" if seed == 1 else "thrust", "instants": [(1.0, "")] if seed == 1 else []} for name, seed in jobs]

    monkeypatch.setattr(ways_out, "cached_figures", rows)
    assert set(verdicts(ways_out.sections(effort)[0]).values()) == {"fails"}


@pytest.mark.parametrize("before, message, verdict", [
    (0.1, "cancelled too late: perched", "holds"), (0.1, "cancelled", "fails"), (0.35, "cancelled", "fails"),
    (0.35, "cancelled too late: perched", "fails")])
def test_a_cancelled_flight_is_attached_for_good_only_where_it_was_too_late(effort, monkeypatch, before, message, verdict):
    def rows(effort, name, jobs, work, good):
        perched = message == "cancelled too late: perched"
        flown = [{"scenario": s, "seed": n, "before": before, "planned": False, "end": "attached", "perched": perched, "message": message,
                  "rate": 1.0, "margin": 0.1, "distance": 1.0, "settled": 0.1} for s, n, _ in jobs] if name == "aborted" else []
        assert all(good(r) == (verdict == "holds") for r in flown)
        return flown

    monkeypatch.setattr(ways_out, "cached_figures", rows)
    found = verdicts(ways_out.sections(effort)[0])
    assert {found[f"{name}: cancelled on the way"] for name in ways_out.CANCELLED_FLIGHTS} == {verdict}


def test_a_perch_after_a_late_cancel_is_known_by_the_result_not_by_its_words():
    flown = {"end": "attached", "before": 0.1, "scenario": "surface_90", "perched": True, "message": "reworded"}
    assert ways_out._too_late(flown) and not ways_out._too_late(flown | {"perched": False, "message": "cancelled too late"})


def test_refusals_that_differ_in_the_interval_found_are_one_line(effort, monkeypatch):
    refusals = [f"clearance in [{low}, inf] m, required [0, inf]" for low in ("-0.2", "-inf", "-0.01")] + ["no stop"]

    def rows(effort, name, jobs, work, good):
        return [] if name == "aborted" else [{"name": "60", "seed": 1, "refused": "", "instants": [(0.5, one) for one in refusals]}]

    monkeypatch.setattr(ways_out, "cached_figures", rows)
    ways_out.sections(effort)
    page = (effort.out / "way_out.md").read_text()
    assert "* 3x 60 deg: clearance in [-inf to -0.01, inf] m, required [0, inf]\n* 1x 60 deg: no stop\n" in page


@pytest.mark.slow
def test_an_inspection_that_is_given_up_has_not_avoided_the_lines(effort, undrawn, monkeypatch):
    scenario = load_scenario("inspection")
    times, states = reference_states(scenario)
    still = inspection_result(scenario, times[:50], np.repeat(states[:1], 50, axis=0), 0, "the controller has landed")
    monkeypatch.setattr(inspection, "fly", lambda *_: still)
    assert still.collisions == 0 and verdicts(inspection._figures(effort))["collisions"] == "fails"
    monkeypatch.setattr(inspection, "fly", lambda *_: dataclasses.replace(still, message=""))
    assert verdicts(inspection._figures(effort))["collisions"] == "holds"


def test_a_line_behind_the_camera_is_not_in_its_middle():
    scenario = load_scenario("inspection")
    _, states = reference_states(scenario)
    lines, vehicle = segments(scenario), load_vehicle(scenario.vehicle)
    away = states.copy()
    away[:, 3:7] = [so3.quat_multiply(q, np.array([0.0, 0.0, 1.0, 0.0])) for q in states[:, 3:7]]
    ahead, behind = (judge(way, lines, watched(scenario, lines), vehicle) for way in (states, away))
    assert ahead.reprojection < 0.8 * ahead.visibility.corner and behind.reprojection == pytest.approx(behind.visibility.corner)
    for judged in (ahead, behind):  # plans have the same measure
        assert judged.visibility.summary()["mean_reprojection_px"] == judged.reprojection and judged.visibility.reprojection.max() <= judged.visibility.corner


def test_shares_of_the_time_in_which_a_line_is_in_view_stand_under_their_own_names(effort, monkeypatch):
    measures = {"mean_reprojection_px": 178.0, "segment_share": 0.99, "seen_share": 0.72}
    monkeypatch.setattr(powerline, "problem", mock.MagicMock())
    monkeypatch.setattr(powerline, "visibility", lambda *_: SimpleNamespace(summary=lambda: measures))
    for draw in ("draw_manoeuvre", "draw_visibility"):
        monkeypatch.setattr(powerline, draw, lambda *_: None)
    low = SimpleNamespace(quantity="height", minimum=0.84, holds=True)
    powerline.problem.plan.return_value.plan.bounds = [low]
    seven, eight = powerline._pictures(effort)
    rows = {row.name: row.ours for row in seven.rows}
    assert not verdicts(eight), "certificates by which plans are returned cannot fail"
    assert rows["80 deg: mean reprojection error"] == "178 px"
    assert rows["80 deg: a part of the line in the image"] == "72 % of the time"
    assert rows["80 deg: nearest point on the segment (14i)"] == "99 % of the time"


@pytest.mark.parametrize("flights, verdict", [(1, "vacuous"), (73, "holds")])
def test_few_perches_do_not_show_a_success_rate(effort, flights, verdict):
    perched = [RunResult(k, k, "perched", "perched", "") for k in range(flights)]
    section = perching._successes(effort, dict.fromkeys(perching.CONDITIONS, perched))
    assert set(verdicts(section).values()) == {verdict}


def test_the_papers_body_rate_is_compared_like_for_like_and_the_other_one_says_what_was_chosen(effort, monkeypatch):
    flights = {name: [RunResult(1, 1, "perched", "perched", "", metrics={"max_body_rate_deg_s": rate, "max_acceleration_m_s2": 10.0})]
               for name, rate in (("surface_90", 427.0), (perching.AGGRESSIVE, 606.0))}
    monkeypatch.setattr(perching, "fly", lambda *_, **__: SimpleNamespace(outcome="perched", message="", contacts=[], flight=None))
    for name in ("FlightView", "plots"):
        monkeypatch.setattr(perching, name, mock.MagicMock())
    rows = {row.name: row for row in perching._figures(effort, flights)[1].rows}
    like = rows["largest body rate, `surface_90`"]
    assert like.verdict == "worse" and like.paper == "close to 600 deg/s"
    chosen = rows["largest body rate, `surface_90_aggressive`"]
    assert chosen.verdict == "holds" and "7.5 m/s^2, was chosen to reach the rate" in chosen.note


def test_errors_of_all_axes_together_are_those_of_each_flight(effort):
    """Each flight is off along another axis: the medians of the axes are zero, the flights' errors are not."""
    flights = [RunResult(k, k, "perched", "perched", "", metrics={f"{kind}_rmse_m_{axis}": 0.1 * (k + 1) if axis == "xyz"[k] else 0.0
                                                                 for kind in ("tracking", "estimation") for axis in "xyz"}) for k in range(3)]
    rows = {row.name: row for row in perching._errors(effort, dict.fromkeys(perching.CONDITIONS, flights)).rows}
    row = rows["90 deg, 1.7 m: tracking, all axes"]
    assert row.ours == "20.0 [10.0, 30.0] cm (3 of 3 flights)" and row.verdict == "FAILS"
