"""The campaign of faults on the real graph: its judgement, its witnesses, its processes, and what a killed campaign keeps."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest
from perch_core.errors import PerchError
from perch_eval.ending import SAFE, Situation, ending
from perch_eval.graph_faults import campaign
from perch_eval.graph_faults.cases import (
    FAULTS, LOCKSTEP, MODES, NODE_PATTERNS, NODES, PHASES, PROCESS, REAL_TIME, Case, cases, first_report)
from perch_eval.graph_faults.flight import UNANSWERED, _FaultInjector
from perch_eval.graph_faults.group import Group
from perch_eval.graph_faults.relay_node import DELAY, Disturbance
from perch_eval.fork_server import alive, session, start
from perch_sim.contact import CRASH_SPEED

CASE = Case("kill", "estimator", "climb", LOCKSTEP)
CODE = {"commit": "1234567", "digest": "now"}


def test_every_node_is_struck_by_every_fault_in_every_phase_and_mode():
    found = cases()
    assert len(found) == len(set(found)) >= 200
    process = [case for case in found if case.fault in PROCESS]
    assert {case[:4] for case in process} == {(f, n, p, m) for f in PROCESS for n in NODES for p in PHASES for m in MODES}
    assert all(case.mode == REAL_TIME for case in found if case.fault not in PROCESS)
    assert {case.fault for case in found} == set(FAULTS) and {case.node for case in found} <= set(NODE_PATTERNS)
    assert max(Counter(case.fault for case in found[:40]).values()) < 20  # the first ones are a sample of all


@pytest.mark.parametrize("situation, end", [
    (Situation(1.2, 0.0, 90.0, 0.0, True, False), "perched"),
    (Situation(1.2, 0.0, 90.0, 900.0, True, False), "held with running motors"),
    (Situation(0.0, 0.0, 1.0, 0.0, False, False), "landed"),
    (Situation(0.05, 0.0, 175.0, 0.0, False, False), "motors off"),
    (Situation(0.05, 0.0, 175.0, 300.0, False, True), "on the ground with running motors"),
    (Situation(1.2, 0.1, 2.0, 800.0, False, True), "hovering"),
    (Situation(1.2, 0.1, 2.0, 800.0, False, False), "in flight"),
    (Situation(1.2, 0.29, 2.0, 800.0, False, True), "hovering"),
    (Situation(1.2, 0.31, 2.0, 800.0, False, True), "in flight"),
    (Situation(1.2, 2.0, 2.0, 800.0, False, True), "in flight"),
    (Situation(1.2, 3.0, 2.0, 0.0, False, False), "in flight"),
])
def test_ends(situation, end):
    assert ending(situation) == end


def test_a_node_is_no_witness_of_itself_and_routine_names_nobody():
    lines = ["[ERROR] [1000000101.0] [estimator]: odometry lost", "[INFO] [1000000101.0] [mission]: odometry is good",
             "[INFO] [1000000102.5] [controller]: descent without position: no odometry",
             "[ERROR] [1000000090.0] [vehicle]: lockstep: estimator has disconnected", "Traceback: estimator"]
    assert first_report(CASE, 1000000100.0, lines, []) == (2.5, "controller: descent without position: no odometry")
    assert first_report(CASE, 1000000100.0, lines[:2], [(1000000101.0, "waits for the estimator")]) is None
    assert first_report(CASE, 1000000100.0, lines, [(1000000101.5, "/estimator has sent no diagnostics for 3 s")])[0] == 1.5


@pytest.mark.parametrize("node, words, counts", [
    ("vehicle", "the simulation has stopped at its maximum", False), ("vehicle", "no IMU for 0.2 s", True),
    ("vehicle", "imu/data_raw: not used", True), ("mission", "no adhesion: hovering at the end of trajectory 3", False),
    ("mission", "the mission was restarted: its goal was dropped", True), ("target_localizer", "looking for the target (no tags detected)", False),
    ("vio_model", "previous plan refused: no time", False), ("vio_model", "/vio_model was restarted", True)])
def test_other_words_name_nobody(node, words, counts):
    assert (first_report(CASE._replace(node=node), 100.0, [], [(101.0, words)]) is not None) is counts


def test_disturbances():
    def passed(fault: str) -> list[int]:
        one = Disturbance()
        one.fault = fault
        found = [m for k in range(100) for m in one.forward(k, 0.0)]
        return found + one.due(DELAY - 0.01) + [-1] + one.due(DELAY + 0.01)

    assert passed("") == [*range(100), -1]
    assert passed("delay") == [-1, *range(100)]
    assert 20 < len(passed("drop")) < 80 and passed("drop") == sorted(passed("drop")[:-1]) + [-1]
    assert passed("duplicate") == [k for k in range(100) for _ in range(2)] + [-1]
    assert passed("reorder")[:4] == [1, 0, 3, 2]


def row(**changes) -> dict:
    return {**CASE._asdict(), "seed": 1, "commit": "abc", "struck": 3.0, "before": [1.0, 0.0, 0.0], "end": "landed", "named": 0.5,
            "words": "w", "goal": "g", "impact": 0.0, "ended": [], "left": [], "duration": 9.0, "code": "now"} | changes


@pytest.mark.parametrize("changes, problem", [
    ({}, []), ({"end": "in flight"}, ["ended in flight"]), ({"named": None}, ["not named"]), ({"named": 7.0}, ["named after 7.0 s"]),
    ({"left": ["process 7"]}, ["left: process 7"]), ({"ended": ["mission"]}, ["mission ended, too"]),
    ({"fault": "drop", "goal": "perched: perched", "end": "perched", "named": None}, []),
    ({"fault": "drop", "goal": "missed", "end": "hovering", "named": None}, ["not named"]),
    ({"struck": None}, ["the flight ended before the fault: g"])])
def test_what_is_not_as_it_should_be_is_said(changes, problem):
    assert campaign.problems(row(**changes)) == problem
    assert all(word in campaign.page([row(**changes)]) for word in problem)


def test_a_vehicle_that_hits_the_floor_faster_than_it_survives_has_crashed_also_in_rows_of_earlier_flights(tmp_path):
    file = tmp_path / campaign.ROWS
    file.write_text("".join(json.dumps(row(node=node, end=end, impact=impact)) + "\n" for node, end, impact in (
        ("controller", "landed", CRASH_SPEED + 0.01), ("mission", "motors off", CRASH_SPEED + 2.0), ("estimator", "landed", CRASH_SPEED))))
    ends = {case.node: one["end"] for case, one in campaign.load(file).items()}
    assert ends == {"controller": "crashed", "mission": "crashed", "estimator": "landed"} and "crashed" not in SAFE
    page = campaign.page(list(campaign.load(file).values()))
    assert "**1 of 3 end safely**" in page and page.count("ended crashed") == 2


def test_shares_of_named_faults_are_of_all_faults_whatever_became_of_the_flight():
    page = campaign.page([row(), row(named=None), row(fault="drop", goal="perched: perched", named=None), row(fault="drop", named=1.0)])
    assert "**1 of 2 faults of processes are named within 5 s**" in page and " 1 of 2 disturbances of messages" in page
    assert " 1 disturbances that are not named had no effect" in page


def test_a_killed_campaign_keeps_what_was_flown(tmp_path, monkeypatch):
    file = tmp_path / campaign.ROWS
    file.write_text(json.dumps(row()) + "\n" + json.dumps(row(node="mission"))[:50])
    assert list(campaign.load(file)) == [CASE]
    flown = []
    monkeypatch.setattr(campaign, "code_version", lambda: CODE)
    monkeypatch.setattr(campaign, "fly_all", lambda missing, *_: flown.extend(missing))
    assert campaign.main(["--out", str(tmp_path), "--logs", str(tmp_path), "--only", "kill estimator climb"]) == 0
    assert flown == [CASE._replace(mode=REAL_TIME)]
    assert "1 of " in (tmp_path / "README.md").read_text() and set(SAFE) >= {"landed"}


def test_flights_in_real_time_have_the_machine_to_themselves(tmp_path, monkeypatch):
    flown = []

    def in_order(_, missing, jobs):
        flown.append((jobs, {case.mode for case in missing}, len(missing)))
        yield from ((case, row(mode=case.mode)) for case in missing)

    monkeypatch.setattr(campaign, "in_processes", in_order)
    campaign.fly_all(campaign.cases()[:40], tmp_path / campaign.ROWS, tmp_path, {}, 3, CODE)
    assert [(jobs, modes) for jobs, modes, _ in flown] == [(3, {campaign.LOCKSTEP}), (1, {REAL_TIME})]
    assert sum(number for *_, number in flown) == 40


def test_a_case_that_could_not_be_flown_is_a_failure_and_the_others_have_their_rows(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(campaign, "code_version", lambda: CODE)
    monkeypatch.setattr(campaign, "in_processes", lambda work, missing, jobs: ((case, row(mode=case.mode, code="now") if case.mode == REAL_TIME
                                                                               else "not flown: not ready: vehicle") for case in missing))
    command = ["--out", str(tmp_path), "--logs", str(tmp_path), "--only", "kill estimator climb"]
    assert campaign.main(command) == 1 and "not ready: vehicle" in capsys.readouterr().err
    assert list(campaign.load(tmp_path / campaign.ROWS, "now")) == [CASE._replace(mode=REAL_TIME)]


def test_rows_are_of_the_code_at_the_start_of_the_campaign(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign, "fly", lambda case, folder, commit: Flown(commit))
    monkeypatch.setattr("perch_eval.revision.digest", lambda: "later")
    assert campaign._fly(tmp_path, CODE, CASE) == {"commit": "1234567", "code": "now"}


def test_rows_of_other_code_are_flown_again_and_dropped(tmp_path, monkeypatch):
    file, other = tmp_path / campaign.ROWS, CASE._replace(node="mission")
    file.write_text(json.dumps(row(code="before")) + "\n" + json.dumps(row(node="mission")) + "\n")
    kept = campaign.load(file, "now")
    assert set(campaign.load(file)) == {CASE, other} and list(kept) == [other]
    campaign.fly_all([], file, tmp_path, kept, 1, CODE)
    assert list(campaign.load(file)) == [other]


@pytest.mark.parametrize("code, older", [("now", False), ("before", True)])
def test_the_page_says_whether_its_rows_are_of_this_code(monkeypatch, code, older):
    monkeypatch.setattr("perch_eval.revision.digest", lambda: "now")
    assert ("older than the code" in campaign.page([row(code=code)])) == older


def test_a_goal_whose_mission_is_gone_is_followed_until_the_fault_has_had_its_time_to_be_named(monkeypatch):
    monkeypatch.setattr("perch_eval.graph_faults.flight.time", SimpleNamespace(time=lambda: 1000.0))
    for case, after, followed in ((CASE._replace(node="mission"), 5.0, True), (CASE._replace(node="mission"), 6.0, False),
                                  (CASE._replace(node="mission", fault="restart"), 60.0, True), (CASE, 60.0, True)):
        injector = _FaultInjector(case, None, None, 1.2, None)
        injector.injection_wall_time = 1000.0 - after
        with nullcontext() if followed else pytest.raises(PerchError, match=UNANSWERED):
            injector.check_goal()


def test_a_process_that_has_to_be_killed_at_the_end_is_residue(monkeypatch):
    monkeypatch.setattr("perch_eval.graph_faults.group.STOP_TIMEOUTS", (1.0, 60.0))
    ends, ignores = (subprocess.Popen([sys.executable, "-c", f"import signal, time; signal.signal(signal.SIGINT, signal.{handler}); "
                                       "print(flush=True); time.sleep(300)"], stdout=subprocess.PIPE) for handler in ("SIG_DFL", "SIG_IGN"))
    ends.stdout.readline(), ignores.stdout.readline()
    group = Group((), CASE, Path(), 43)
    group.pids = {"mission": ends.pid, "controller": ignores.pid}
    group.stop()
    assert (ends.wait(), ignores.wait()) == (-signal.SIGINT, -signal.SIGKILL)
    assert group.leftovers() == ("process controller after SIGINT",)


def test_processes_of_a_fork_server_are_their_own(tmp_path, monkeypatch):
    (tmp_path / "sleeper.py").write_text(
        "import os, subprocess, sys, time\ndef sleeper():\n    print(sys.argv[1], os.environ['WORD'], flush=True)\n"
        "    subprocess.Popen(['sleep', '60'])\n    time.sleep(60)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    pids = [start("sleeper:sleeper", [f"number {k}"], tmp_path / f"{k}.log", {"WORD": "heard"}, "sleeper") for k in range(2)]
    until(lambda: all(len(session(pid)) == 2 for pid in pids))
    assert [Path(tmp_path / f"{k}.log").read_text() for k in range(2)] == ["number 0 heard\n", "number 1 heard\n"]
    os.kill(pids[0], signal.SIGKILL)
    until(lambda: not alive(pids[0]))
    assert len(session(pids[0])) == 1  # what it has started is still found
    for pid in pids:
        os.killpg(pid, signal.SIGKILL)


@pytest.mark.parametrize("begun", [False, True])
def test_processes_of_a_fork_server_end_with_a_caller_that_is_killed(tmp_path, monkeypatch, begun):
    (tmp_path / "sleeper.py").write_text("import time\ndef sleeper():\n    print('up', flush=True)\n    time.sleep(300)\n")
    monkeypatch.setenv("PYTHONPATH", f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    log = tmp_path / "log"
    caller = subprocess.Popen([sys.executable, "-c", (
        "import time; from pathlib import Path; from perch_eval.fork_server import start\n"
        f"print(start('sleeper:sleeper', [], Path({str(log)!r}), {{}}, 'sleeper'), flush=True); time.sleep(60)")],
        stdout=subprocess.PIPE, text=True)
    pid = int(caller.stdout.readline())
    until(lambda: not begun or log.exists() and log.read_text())
    caller.kill(), caller.wait()
    until(lambda: not alive(pid))


@dataclass(frozen=True)
class Flown:
    commit: str


def until(done, patience=120.0):
    end = time.monotonic() + patience
    while not done():
        assert time.monotonic() < end
        time.sleep(0.01)
