"""The bench harness judges bars by the statistic they name."""

from __future__ import annotations

import importlib
import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import harness
import machine
import numpy as np
import pytest


def test_bars_are_judged_by_their_statistic():
    samples = [1.0] * 99 + [50.0]
    assert harness.figure("a", "ms", samples, bar=2.0).holds is True
    assert harness.figure("a", "ms", samples, bar=2.0, comparison="max <=").holds is False
    assert harness.figure("a", "", [60.0], bar=50.0, comparison="median >=").holds is True
    assert harness.figure("a", "", [0.0, 0.0], bar=0.0, comparison="max ==").holds is True
    assert harness.figure("a", "", [float("nan")], bar=1.0).holds is False
    assert harness.figure("a", "ms", samples).holds is None
    skewed = [1.0] * 90 + [5.0] * 9 + [50.0]  # median 1, p99 5.45, max 50, min 1
    for bar, holding in ((0.5, set()), (2.0, {"median"}), (6.0, {"median", "p99"}), (50.0, {"median", "p99", "max"})):
        assert {name for name in ("median", "p99", "max") if harness.figure("a", "ms", skewed, bar, f"{name} <=").holds} == holding
        assert harness.figure("a", "ms", skewed, bar).holds == ("median" in holding), "the median is judged where nothing else is named"
    assert [harness.figure("a", "", [1.0, 2.0, 9.0], 1.5, f"{name} >=").holds for name in ("min", "median", "max")] == [False, True, True]


def test_malformed_figures_are_refused():
    with pytest.raises(ValueError, match="no samples"):
        harness.figure("a", "ms", [])
    with pytest.raises(ValueError, match="comparison"):
        harness.figure("a", "ms", [1.0], bar=1.0, comparison="mean <")


def test_a_powerline_perch_without_recovery_is_not_solved(monkeypatch):
    from perch_core.errors import PlanningRefusal

    monkeypatch.setitem(sys.modules, "powerline_ipopt", SimpleNamespace())
    powerline = importlib.import_module("powerline")
    part = SimpleNamespace(cpu_time=0.01, solve_time=0.01, iterations=9, bounds=())
    plans = [SimpleNamespace(perch=part, recovery=recovery, bounds=(), without_recovery="no room") for recovery in (part, None)]
    answers = [powerline._answer(SimpleNamespace(plan=lambda _, plan=plan: plan), None) for plan in plans]

    def refuse(_):
        raise PlanningRefusal("solver", "perch", -1.0, "none")

    answers.append(powerline._answer(SimpleNamespace(plan=refuse), None))
    assert [bool(answer["missing"]) for answer in answers] == [False, True, True] and answers[1]["missing"] == "no recovery: no room"
    assert ["perch_ms" not in answer for answer in answers] == [False, False, True]  # starts anywhere: perches alone


def test_the_law_that_is_timed_accepts_the_contact_whose_check_is_timed():
    control = importlib.import_module("control")
    control._geometric().check_contact(control.FlatReference(control.perch("surface_90_1.7m").trajectory))


def test_measure_counts_only_after_the_warm_up():
    calls = []
    times = harness.measure(lambda: calls.append(None), repetitions=7, warm_up=2)
    assert len(calls) == 9 and times.shape == (7,) and (times >= 0.0).all()


def test_json_and_table_name_every_figure():
    items = [harness.figure("plan", "ms", [0.3], bar=0.5), harness.figure("import", "s", [1.0])]
    written = harness.as_json({"planner": items})
    assert [(one["group"], one["name"]) for one in written] == [("planner", "plan"), ("planner", "import")]
    assert {"name", "unit", "median", "p99", "n", "bar", "holds"} <= set(written[0])
    assert "holds" in harness.table(items) and "import" in harness.table(items)


def test_a_results_file_names_code_command_and_machine(monkeypatch):
    monkeypatch.setattr(harness, "code_version", lambda: {"commit": "1234567", "digest": "0123456789ab"})
    monkeypatch.setattr(sys, "argv", ["scripts/bench.py", "sim"])
    found = harness.provenance()
    assert (found["commit"], found["digest"], found["command"]) == ("1234567", "0123456789ab", "python3 scripts/bench.py sim")
    assert found["machine"]["cores"] >= 1 and found["machine"]["cpu"]


# -- the planner's campaign ------------------------------------------------------------------------------------------


@pytest.fixture
def campaign(monkeypatch):
    """`bench/planner_campaign.py`, in which problems are numbers, and a plan of one has as many findings; a negative one cannot be planned."""
    module = importlib.import_module("planner_campaign")

    def plan(problem, *_):
        if problem == 7:
            raise ZeroDivisionError("of the planner")
        return SimpleNamespace(duration=1.0, trajectory=SimpleNamespace(durations=problem, coefficients=None))

    def verify(problem, *_):
        if problem == 8:
            raise ZeroDivisionError("of the verifier")
        return [SimpleNamespace(requirement="thrust", excess=1.0, time=0.5)] * (problem == 9)

    for name, value in {"plan": plan, "verify": verify, "requirements": lambda *_: None, "random_problem": lambda rng: rng.seed,
                        "np": SimpleNamespace(**vars(np) | {"random": SimpleNamespace(default_rng=lambda seed: SimpleNamespace(seed=seed))})}.items():
        monkeypatch.setattr(module, name, value)
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    yield module
    for number, handler in handlers.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("first, code, exceptions, findings", [
    (1, 0, [], []), (6, 1, [7, 8], []), (8, 1, [8], [9])])
def test_an_exception_of_planner_or_verifier_is_a_result_and_does_not_end_the_campaign(campaign, tmp_path, first, code, exceptions, findings):
    assert campaign.main(["--first", str(first), "--count", "3", "--out", str(tmp_path / "new" / "out.json")]) == code
    written = json.loads((tmp_path / "new" / "out.json").read_text())
    assert written["problems"] == 3 and written["machine"]["cpu"]
    assert [seed for seed, _ in written["exceptions"]] == exceptions and [seed for seed, *_ in written["findings_of_the_verifier"]] == findings


def test_an_interrupted_campaign_writes_what_it_has(campaign, monkeypatch, tmp_path):
    def interrupted(rng):
        if rng.seed == 3:
            raise KeyboardInterrupt
        return rng.seed

    monkeypatch.setattr(campaign, "random_problem", interrupted)
    assert campaign.main(["--first", "1", "--out", str(tmp_path / "out.json")]) == 0
    assert json.loads((tmp_path / "out.json").read_text())["problems"] == 2


@pytest.mark.parametrize("words", [("--count", "0"), ("--first", "-1"), ("--step", "0"), ("--step", "nan"), ("--out", "/proc/none/out.json"), ("--out", ".")])
def test_a_campaign_refuses_what_it_cannot_work_with(campaign, capsys, words):
    try:
        code = campaign.main([*words])
    except SystemExit as end:
        code = end.code
    assert code == 2 and words[0] in capsys.readouterr().err.splitlines()[-1]


# -- the machine -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("gap, touch, down", [(None, False, math.inf), (10.0, False, math.inf), (0.5, False, math.nan), (None, True, math.nan)])
def test_a_vehicle_that_is_not_level_when_commands_go_on_or_it_touches_the_wall_fails_the_bar(monkeypatch, gap, touch, down):
    """The descent, which begins later, is left open then."""
    autopilot = importlib.import_module("autopilot")
    touched, tilted = [], np.array([0.5, 0.0, 0.0, 0.866])
    body = SimpleNamespace(plant=SimpleNamespace(rotor_speed=np.ones(4)), state=SimpleNamespace(q_WB=tilted))
    loop = SimpleNamespace(time=0.0, close=lambda: None, vehicle=SimpleNamespace(simulation=body))

    def step():
        loop.time += 0.1
        touched.extend([loop.time] if touch and loop.time > 2.0 else [])

    loop.step = step
    assert autopilot.level_from(np.array([0.0, 0.1, 0.2]), np.array([40.0, 5.0, 3.0])) == 0.1
    link = SimpleNamespace(kill=lambda: None, last_command=1.0, watchdog=SimpleNamespace(mode=autopilot.Mode.FOLLOWING))
    monkeypatch.setattr(autopilot, "start_flight", lambda: (loop, link, touched))
    found = autopilot.stopped(1.0, gap)
    assert found.levelled == math.inf and (found.down == down or math.isnan(found.down) and math.isnan(down))
    for name, value in (("stopped", lambda *_: replace(found, down=math.inf)), ("phase_times", lambda: {"hover": 1.0}), ("levelled", lambda *_: 0.1),
                        ("held_without_link", lambda: 0.01), ("taken_over", lambda _: 0.01), ("ensure_program", lambda: None)):
        monkeypatch.setattr(autopilot, name, value)
    judged = {one.name: one.holds for one in autopilot.figures(True)}
    assert judged["level within 10 deg"] is judged["descent or motors off"] is False


def test_a_flight_that_never_perches_is_an_error_and_not_endless(monkeypatch):
    autopilot = importlib.import_module("autopilot")
    loop = SimpleNamespace(time=0.0, close=lambda: None, trace=SimpleNamespace(phases=[(1.0, "tracking", "")]))
    loop.step = lambda: setattr(loop, "time", loop.time + 0.1)
    monkeypatch.setattr(autopilot, "start_flight", lambda: (loop, None, [2.0]))
    with pytest.raises(KeyError, match="^'(take_off|searching|planning|verifying|perched)'$"):
        autopilot.phase_times()
    assert loop.time == pytest.approx(autopilot.PERCH_TIME_MAX, abs=0.15)


def test_time_that_the_host_took_is_read_from_the_kernel(tmp_path, monkeypatch):
    stat, clock = tmp_path / "stat", iter((10.0, 20.0))
    monkeypatch.setattr(machine, "time", SimpleNamespace(monotonic=lambda: next(clock)))  # of this module alone: others read it, too
    monkeypatch.setattr(machine, "os", SimpleNamespace(cpu_count=lambda: 2, sysconf=lambda name: 100))
    stat.write_text("cpu  1 2 3 4 5 6 7 500 0 0\ncpu0 1 2 3 4 5 6 7 250 0 0\n")
    stolen = machine.StolenTime(stat)
    stat.write_text("cpu  9 9 9 9 9 9 9 520 0 0\ncpu0 1 2 3 4 5 6 7 270 0 0\n")
    assert stolen.share() == pytest.approx(1.0)  # 0.2 s of 10 s of two cores


SPINNING = """
import machine, multiprocessing, os, sys, time
try:
    with machine.cores_awake():
        pids = [p.pid for p in multiprocessing.active_children()]
        while any(os.sched_getscheduler(pid) != os.SCHED_IDLE for pid in pids):  # they are being started
            time.sleep(0.01)
        print(*pids, flush=True)
        time.sleep(60)
except KeyboardInterrupt:  # as in scripts/bench.py
    sys.exit(130)
"""


def test_ctrl_c_ends_spinning_processes_without_a_traceback():
    bench = subprocess.Popen([sys.executable, "-c", SPINNING], cwd=Path(machine.__file__).parent, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
                             text=True, start_new_session=True)
    bench.stdout.readline()
    os.killpg(bench.pid, signal.SIGINT)  # as a terminal does
    assert bench.communicate(timeout=30.0)[1] == "" and bench.returncode == 130  # all have closed it


def test_spinning_processes_end_with_a_bench_that_was_killed():
    bench = subprocess.Popen([sys.executable, "-c", SPINNING], cwd=Path(machine.__file__).parent, stdout=subprocess.PIPE, text=True)
    pids = [int(pid) for pid in bench.stdout.readline().split()]
    bench.kill()
    bench.wait()
    assert len(pids) == os.cpu_count()
    for _ in range(300):
        if not any(_alive(pid) for pid in pids):
            return
        time.sleep(0.1)
    raise AssertionError("still spinning")


def _alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except OSError:
        return False
