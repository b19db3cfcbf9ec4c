"""The evaluation: verdicts, exit codes, the cable's exact figures, and the nonlinear comparison."""

import fcntl
import json
import math
import os
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from perch_core import bernstein
from perch_core.vehicle import GRAVITY, load_vehicle
from perch_eval.campaign.engines import Task
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import Run
from perch_eval.evaluation import command, control, inspection, kept, planning_times
from perch_eval.evaluation.cable import cable_of_length, cable_sections
from perch_eval.evaluation.planning_times import SETTINGS, solve, waypoint_problem
from perch_eval.evaluation.document import Effort, Section
from perch_planner.paper import paper_m


def part(*claims, missing=False):
    def make(effort):
        section = Section("s", "A table", "seeds 1 to 5")
        for k, holds in enumerate(claims):
            section.claim(f"claim {k}", "1 | 2", "3", holds, "smaller")
        section.claim("recoveries", "0 of 0", "", None, "all that did not grip")
        section.compare("a comparison", "4 cm", "3 cm", False)
        if missing:
            section.missing("flown", "7 cm", "no such flight yet")
        section.data = {"x": math.nan}
        return [section]

    return make


def broken(effort):
    raise RuntimeError("no fuel")


def asserts(effort):
    raise AssertionError


@pytest.fixture
def parts(monkeypatch, tmp_path):
    """Sets the parts of the evaluation; in an empty folder, outside a repository's digest, which takes time."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("perch_eval.revision.commit", lambda: "1234567")
    monkeypatch.setattr("perch_eval.revision.digest", lambda: "0123456789ab")

    def set_parts(**parts):
        monkeypatch.setattr(command, "PARTS", {name: name for name in parts})
        monkeypatch.setattr(command, "resolved", lambda place: parts[place.rpartition(".")[2]])

    return set_parts


def test_a_part_that_fails_in_any_way_is_a_row_and_the_others_go_on(parts):
    parts(a=asserts, b=part(True))
    first, second = command.evaluate(None, ["a", "b"])
    assert [row.verdict for row in first.rows] == ["not available"] and second.rows[0].verdict == "holds"


def flying(flown):
    """A part with two flights."""
    def make(effort):
        def pool(work, jobs, processes, dead):
            flown.extend(jobs)
            yield from ((job, {"x": 1}) for job in jobs)

        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(kept, "in_processes", pool)
            kept.cached_figures(effort, "shared", [1, 2], None, lambda row: True)
        return []

    return make


def test_flights_that_parts_share_are_flown_once_and_again_when_asked_for(parts):
    flown = []
    parts(a=flying(flown), b=flying(flown))
    for arguments, flights in (([], 2), ([], 2), (["--fresh"], 4), ([], 4)):
        assert command.main(arguments + ["--out", "results"]) == 0 and len(flown) == flights


def test_flights_of_code_that_was_changed_meanwhile_are_not_stored_as_those_of_the_code_before(parts, monkeypatch, capsys):
    flown, digests = [], iter(["0123456789ab", "0123456789ab", "ba9876543210"])
    parts(a=flying(flown))
    monkeypatch.setattr("perch_eval.revision.digest", lambda: next(digests))
    assert command.main(["--out", "results"]) == 2 and "changed during the evaluation; start the evaluation again" in capsys.readouterr().err
    kept_rows = Path("out/evaluation/quick/shared_0123456789ab.jsonl").read_text().splitlines()
    assert len(flown) == 2 and len(kept_rows) == 1 and not Path("results/README.md").exists()


def test_flights_of_unknown_code_are_not_reused(tmp_path):
    flown = []
    effort = Effort(True, 1, tmp_path, tmp_path, "", range(1), range(1), 1, {"commit": "unknown", "digest": ""})
    flying(flown)(effort), flying(flown)(effort)
    assert flown == [1, 2, 1, 2]


def test_flights_that_could_not_be_carried_out_are_flown_again(tmp_path, monkeypatch):
    flown, cause = [], "error"

    def pool(work, tasks, processes, dead):
        for task in tasks:
            flown.append(task.run.number)
            yield task, asdict(RunResult(task.run.number, 1, cause if task.run.number else "perched", "", ""))

    monkeypatch.setattr(kept, "in_processes", pool)
    monkeypatch.setattr("perch_eval.revision.digest", lambda: "0123456789ab")
    effort = Effort(True, 1, tmp_path, tmp_path, "", range(1), range(1), 1, {"commit": "1234567", "digest": "0123456789ab"})
    tasks = [Task(Run(k, 1, {}), {}, "in_process", None) for k in range(2)]
    kept.cached_runs(effort, "flights", tasks)
    cause = "perched"
    assert [r.cause for r in kept.cached_runs(effort, "flights", tasks)] == ["perched"] * 2 and flown == [0, 1, 1]


def test_a_page_is_of_the_code_with_which_its_flights_began(parts, monkeypatch):
    def edited(effort):
        monkeypatch.setattr("perch_eval.revision.digest", lambda: "ba9876543210")
        return []

    parts(a=edited)
    assert command.main(["--out", "results"]) == 0
    assert "> **Of commit 1234567, older than the code**" in Path("results/README.md").read_text()
    assert json.loads(Path("results/results.json").read_text())["digest"] == "0123456789ab"


@pytest.mark.parametrize("arguments, folder", [([], "out/results"), (["--full", "--only", "a"], "out/results"), (["--full"], "docs/results")])
def test_only_an_evaluation_of_everything_replaces_the_committed_page_by_default(parts, arguments, folder):
    parts(a=part(True), b=part(True))
    assert command.main(arguments) == 0
    assert {str(page) for page in Path().rglob("README.md")} == {f"{folder}/README.md"}


def test_an_interrupted_evaluation_leaves_pages_and_figures_as_they_were(parts, capsys):
    def drawing(effort):
        (effort.out / "figure.png").write_text("new")
        if interrupts:
            raise KeyboardInterrupt
        return part(True)(effort)

    parts(a=drawing)
    Path("results").mkdir()
    for name in ("figure.png", "README.md", "notes.txt"):
        Path("results", name).write_text("old")
    for interrupts, code, content in ((True, 130, ["old", "old", "old"]), (False, 0, ["new", "# Res", "old"])):
        assert command.main(["--out", "results"]) == code
        assert [Path("results", name).read_text()[:5] for name in ("figure.png", "README.md", "notes.txt")] == content
    assert "finished flights are kept: the same command" in capsys.readouterr().err
    assert {file.name for file in Path("results").iterdir()} == {"figure.png", "README.md", "notes.txt", "results.json"}


def test_two_evaluations_at_once_would_lose_flights_and_are_refused(parts, capsys):
    parts(a=part(True))
    Path("out/evaluation/quick").mkdir(parents=True)
    lock = os.open("out/evaluation/quick", os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert command.main(["--out", "results"]) == 2 and "out/evaluation/quick: another run is writing there" in capsys.readouterr().err
    finally:
        os.close(lock)


@pytest.mark.slow
@pytest.mark.parametrize("parts, code", [
    ({"a": part(True, True)}, 0), ({"a": part(True, False)}, 1), ({"a": part(True, missing=True)}, 3),
    ({"a": part(False, missing=True)}, 1), ({"a": broken}, 3), ({"a": broken, "b": part(False)}, 1)])
def test_the_exit_code_tells_failed_claims_and_missing_rows(tmp_path, monkeypatch, parts, code):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(command, "PARTS", {name: name for name in parts})
    monkeypatch.setattr(command, "resolved", lambda place: parts[place.rpartition(".")[2]])
    assert command.main(["--out", "results"]) == code
    page = (tmp_path / "results" / "README.md").read_text()
    content = json.loads((tmp_path / "results" / "results.json").read_text())
    assert ("**FAILS**" in page) == ("| part | row | value | claim |" in page) == (code == 1)
    assert page.index("claims hold") < page.index("*holds*: ") < page.index("Made by ") < page.index("\n## ")
    assert "| 0 of 0 |  | *vacuous* |" in page or parts == {"a": broken}
    assert "`python3 scripts/evaluate.py --seeds 5 --line-seeds 1 --layouts 3 --out results` on " in page
    assert content["command"].endswith("--out results") and len(content["digest"]) == 12 and content["commit"] and content["machine"]
    assert ("*not available*" in page) == any(row["verdict"] == "not available" for s in content["sections"] for row in s["rows"])
    assert not [line for line in page.splitlines() if line.startswith("|") and "1 | 2" in line]  # a cell keeps its table whole


@pytest.mark.slow
def test_parts_have_their_places_on_the_page_whatever_order_they_are_asked_for_in(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    parts = dict.fromkeys("abc", part(True))
    monkeypatch.setattr(command, "PARTS", {name: name for name in parts})
    monkeypatch.setattr(command, "resolved", lambda place: parts[place.rpartition(".")[2]])
    assert command.main(["--only", "c", "--only", "a", "--out", "results"]) == 0
    assert [line for line in capsys.readouterr().out.splitlines() if line.startswith("[")] == ["[1/2] a", "[2/2] c"]


@pytest.mark.parametrize("arguments", [["--jobs", "0"], ["--seeds", "-1"], ["--line-seeds", "many"]])
def test_wrong_arguments_are_invalid_input(arguments):
    with pytest.raises(SystemExit) as end:
        command.main(arguments)
    assert end.value.code == 2


@pytest.mark.parametrize("share", [0.01, 0.025, 0.05])
def test_the_cable_has_its_length_and_sag(share):
    cable = cable_of_length(185.0, share)
    points = cable.sample(20001)
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).sum() == pytest.approx(185.0, abs=1e-3)
    assert -points[:, 2].min() == pytest.approx(share * points[-1, 0], rel=1e-6)


def test_the_mean_segment_length_which_follows_from_the_count_is_no_claim(tmp_path):
    [section] = cable_sections(Effort(True, 1, tmp_path, tmp_path, "test", range(1, 2), range(1, 2), 1, {}))
    assert {row.name for row in section.rows if row.verdict == "holds"} == {"mean error of 15 segments"}


@pytest.mark.parametrize("waypoints", [3, 10])
@pytest.mark.slow
def test_the_nonlinear_program_keeps_the_thrust_bound_and_costs_no_more_than_the_papers_plan(waypoints):
    vehicle = load_vehicle("snapdragon")
    planned = paper_m.plan(waypoint_problem(np.random.default_rng(1), waypoints), SETTINGS, vehicle)
    durations = planned.trajectory.durations
    found = solve(planned.iterations[-1].program, vehicle.mass, 4.5)
    assert found.converged and found.thrust_max <= 4.5 * 1.001

    def snap(coefficients):
        total = 0.0
        for segment, T in zip(coefficients, durations):
            s = np.linspace(0.0, 1.0, 2001)
            fourth = bernstein.derivative(segment, 4) / T**4
            values = fourth @ bernstein.basis(fourth.shape[-1] - 1, s).T
            total += T * np.trapezoid((values**2).sum(axis=0), s)
        return total

    # The plan was stretched until its bound held by itself: there the nonlinear program has the same optimum.
    assert snap(found.coefficients) == pytest.approx(snap(planned.trajectory.coefficients[:, :3]), rel=1e-3)
    # An independent look at the thrust, between the samples too.
    for segment, T in zip(found.coefficients, durations):
        second = bernstein.derivative(segment, 2) / T**2
        a = (second @ bernstein.basis(second.shape[-1] - 1, np.linspace(0.0, 1.0, 4001)).T).T
        assert vehicle.mass * np.linalg.norm(a + [0.0, 0.0, GRAVITY], axis=1).max() < 4.6


def test_a_comparison_with_a_flight_that_was_not_begun_is_written(tmp_path, monkeypatch):
    """Its errors are kept as nulls."""
    def known(effort, name, jobs, fly, good):
        flown = [dict(zip(("controller", "condition", "maneuver", "seed"), job), rmse=[0.01, 0.02, 0.03], outcome="perched") for job in jobs]
        flown[-1] |= {"rmse": [None] * 3, "outcome": "not begun: refused"}
        return flown

    monkeypatch.setattr(control, "cached_figures", known)
    sections = control.comparison_sections(Effort(True, 1, tmp_path, tmp_path, "test", range(1, 2), range(1, 2), 1))
    page = (tmp_path / "comparison.md").read_text()
    assert len(sections) == 1 and "not begun: refused" in page and control.GIVEN_PAD in page


def test_the_page_of_faults_says_what_the_planner_is_given(tmp_path, monkeypatch):
    monkeypatch.setattr(control, "cached_figures", lambda *_: [])
    [section] = control.fault_sections(Effort(True, 1, tmp_path, tmp_path, "test", range(1, 2), range(1, 2), 1))
    assert control.GIVEN_PAD in section.about and control.GIVEN_PAD in (tmp_path / "faults_in_flight.md").read_text()


@pytest.mark.parametrize("count, collisions, verdict", [(3, 0, "vacuous"), (3, 1, "FAILS"), (20, 0, "holds"), (20, 1, "FAILS")])
def test_few_inspections_without_a_collision_do_not_show_what_many_do(tmp_path, monkeypatch, count, collisions, verdict):
    def known(effort, name, jobs, fly, good):
        return [{"seed": seed, "reference_collisions": 2, "collisions": collisions * (seed == 1), "collisions_without": 2, "reference_px": 100.0,
                 "flown_px": 10.0, "clearance": 1.0, "cheirality": 1.0, "segment": 1.0, "completed": True, "mapped": 3, "lines": 3} for seed in jobs]

    monkeypatch.setattr(inspection, "cached_figures", known)
    section = inspection._layouts(Effort(True, 1, tmp_path, tmp_path, "test", range(1, 2), range(1, 2), count, {}))
    assert next(row for row in section.rows if row.name == "collisions").verdict == verdict


@pytest.mark.parametrize("factor, verdict", [(7.7, "worse"), (140.0, "better")])
def test_the_ratio_of_planning_times_is_compared_with_the_papers(tmp_path, monkeypatch, factor, verdict):
    """The paper's: 527 ms / 4 ms with 3 waypoints, 1253 ms / 18 ms with 10."""
    iteration = SimpleNamespace(program=None)
    found = SimpleNamespace(solved=True, solve_time=1e-3, iterations=[iteration])
    monkeypatch.setattr(planning_times, "_fastest", lambda *_: found)
    monkeypatch.setattr(planning_times, "solve", lambda *_: SimpleNamespace(converged=True, solve_time=factor * 1e-3))
    section = planning_times._table(Effort(False, 1, tmp_path, tmp_path, "test", range(1, 2), range(1, 2), 1, {}), load_vehicle("snapdragon"))
    assert {row.verdict for row in section.rows if "/ QP" in row.name} == {verdict}
    assert {row.name.partition(", ")[0] for row in section.rows if row.name.endswith("wall clock")} == {"shipped planner"}
    assert sum(row.name.endswith("CPU time") for row in section.rows) == 4
