"""Replanning's gain: flights are compared in pairs that differ in nothing else."""

import pytest

from perch_eval.campaign.results import RunResult
from perch_eval.replanning import pairs, plot, summary


def flight(number, seed, angle, replan, offset, cause="perched"):
    return RunResult(number, seed, cause, "", "", {"mission.replan": replan, "target.inclination_deg": angle},
                     {"contact_offset_m": offset, "contact_normal_speed_m_s": 0.5, "contact_tangential_speed_m_s": 0.1,
                      "contact_tilt_error_deg": 2.0})


RESULTS = [flight(0, 1, 90.0, False, 0.04), flight(1, 1, 60.0, True, 0.01), flight(2, 1, 90.0, True, 0.02),
           flight(3, 2, 90.0, False, None, "missed_pad"), flight(4, 2, 90.0, True, 0.03)]


def test_pairs_differ_in_replanning_alone():
    found = pairs(RESULTS)
    assert [(a.number, b.number) for a, b in found] == [(0, 2), (3, 4)]


def test_a_flight_that_missed_counts_as_such_and_has_no_contact_to_compare(tmp_path):
    found = pairs(RESULTS)
    out = summary(found)
    assert out["without"]["perched"].startswith("1/2") and out["with"]["perched"].startswith("2/2")
    assert out["with"]["contact_offset_m"] == {"median": pytest.approx(0.025), "largest": pytest.approx(0.03)}
    assert out["lower_with"]["contact_offset_m"].startswith("1/1")
    plot(found, tmp_path / "replanning.png")
    assert (tmp_path / "replanning.png").stat().st_size > 1000


def test_results_without_the_switch_are_refused():
    with pytest.raises(ValueError, match="mission.replan"):
        pairs([RunResult(0, 1, "perched", "", "", {"seed": 1})])
