"""Campaign files, draws, causes of failure, results and their ranking."""

import json
import math
import sys
from concurrent.futures import Future, ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from unittest.mock import MagicMock

import cv2
import numpy as np
import pytest
from scipy.stats import kstest

from perch_core import config
from perch_core.errors import ConfigError, PerchError
from perch_core.values import Contact
from perch_eval import demo
from perch_eval.campaign import command as campaign
from perch_eval.campaign import workers
from perch_eval.campaign.causes import cause_of
from perch_eval.campaign.engines import Task, run_task
from perch_eval.campaign.report import cells_of
from perch_eval.campaign.results import Results, ResultsError, RunResult, read_results, worst
from perch_eval.campaign.specification import Run, load_campaign, parse_distribution
from perch_eval.evaluation import command as evaluation
from perch_eval.revision import OtherCodeError
from perch_eval.statistics import Rate, Spread
from perch_sim.contact_event import ContactState
from perch_sim.scenario import Scenario


def write(folder, text):
    file = folder / "c.yaml"
    file.write_text(text)
    return file


def test_draws_follow_their_distributions():
    rng = np.random.default_rng(1)
    uniform = [parse_distribution("c", "a", {"uniform": [2.0, 5.0]}).draw(rng) for _ in range(2000)]
    normal = [parse_distribution("c", "a", {"normal": [1.0, 0.1]}).draw(rng) for _ in range(2000)]
    assert kstest(uniform, "uniform", (2.0, 3.0)).pvalue > 0.01
    assert kstest(normal, "norm", (1.0, 0.1)).pvalue > 0.01
    limited = [parse_distribution("c", "a", {"normal": [1.0, 0.1], "low": 0.95, "high": 1.2}).draw(rng) for _ in range(2000)]
    assert min(limited) >= 0.95 and max(limited) <= 1.2
    assert kstest(limited, "truncnorm", (-0.5, 2.0, 1.0, 0.1)).pvalue > 0.01  # drawn again, not cut off: no value is more frequent
    assert {parse_distribution("c", "a", {"choice": [1, 2, 3]}).draw(rng) for _ in range(100)} == {1, 2, 3}


@pytest.mark.parametrize("entry", [3.0, {}, {"uniform": [1, 2], "choice": [1]}, {"uniform": [2, 1]}, {"uniform": [1]},
                                   {"normal": [0, 0]}, {"choice": []}, {"gauss": [0, 1]}, {"uniform": [0, 1], "low": 0},
                                   {"choice": [60.0, [75.0], 90.0]}, {"grid": [1, "a"]}, {"grid": [[1, 2], [1]]}, {"choice": [math.nan]}, {"grid": [None]}])
def test_a_distribution_that_says_nothing_is_refused(entry):
    with pytest.raises(ConfigError, match="vary.a"):
        parse_distribution("c.yaml", "vary.a", entry)


def test_a_worker_of_a_cluster_with_other_code_ends_the_campaign(monkeypatch):
    code = iter(["campaign's", "campaign's", "worker's"])
    for module in ("perch_eval.revision", "perch_eval.campaign.workers"):
        monkeypatch.setattr(f"{module}.digest", lambda: next(code))
    monkeypatch.setattr(workers, "require", lambda extra: None)
    monkeypatch.setattr(workers, "run_task", lambda task: task.run.number)

    def submit(work, *arguments, **_):
        future = ThreadPoolExecutor(1).submit(work, *arguments)
        future.release = lambda: None
        return future

    cluster = SimpleNamespace(Client=lambda *_, **__: MagicMock(submit=submit), as_completed=list)
    monkeypatch.setitem(sys.modules, "distributed", cluster)
    results = workers.on_cluster([Task(Run(number, 1, {}), {}, "in_process", None) for number in (1, 2)], "tcp://host:8786")
    with pytest.raises(OtherCodeError, match="other code than the campaign"):
        list(results)


def test_files_that_a_campaign_names_are_found_beside_it(tmp_path, monkeypatch):
    folder, elsewhere = tmp_path / "my campaigns", tmp_path / "elsewhere"
    folder.mkdir(), elsewhere.mkdir()
    (folder / "wall.yaml").write_text("extends: surface_90\nname: wall\nvehicle: light.yaml\n")
    for name, mass in (("light", 0.24), ("heavy", 0.26)):
        (folder / f"{name}.yaml").write_text(f"extends: snapdragon\nmass: {mass}\n")
    file = write(folder, "name: c\nscenario: wall.yaml\nruns: 1\nvary: {vehicle: {grid: [light.yaml, heavy.yaml, snapdragon]}}\n")
    monkeypatch.chdir(elsewhere)
    campaign = load_campaign(file)
    assert [campaign.mapping(run)["vehicle"] for run in campaign.runs] == [str(folder / "light.yaml"), str(folder / "heavy.yaml"), "snapdragon"]
    assert [run.values["vehicle"] for run in campaign.runs] == ["light.yaml", "heavy.yaml", "snapdragon"]


@pytest.mark.parametrize("vary, vehicle", [("wind.gust_sigma: {grid: [0.1]}", "rpg"), ("vehicle: {grid: [rpg, snapdragon]}", None)])
def test_the_report_names_scenario_vehicle_and_code(tmp_path, monkeypatch, vary, vehicle):
    from perch_eval.campaign import report

    monkeypatch.setattr(report, "code_version", lambda: {"commit": "1234567+", "digest": "abc"})
    (tmp_path / "wall.yaml").write_text("extends: surface_60\nname: my wall\nvehicle: rpg\n")
    page = report.write_report(load_campaign(write(tmp_path, f"name: c\nscenario: wall.yaml\nruns: 1\nvary: {{{vary}}}\n")), [], tmp_path).read_text()
    for row in ("<th>scenario</th><td>my wall</td>", "<th>commit</th><td>1234567+ (digest abc)</td>"):
        assert row in page
    assert (f"<th>vehicle</th><td>{vehicle}</td>" if vehicle else "<th>varied</th><td>vehicle: grid") in page
    assert page.count("<th>vehicle</th>") == bool(vehicle)


def test_medians_of_the_report_have_the_number_of_their_values():
    from perch_eval.campaign import report

    found = [RunResult(k, k, cause, "", "", metrics={"contact_offset_m": offset}) for k, (cause, offset) in enumerate(
        [("perched", 0.01), ("perched", 0.03), ("tilt", 0.05), ("not_found", None)])]
    page = report._spreads(found, {"contact_offset_m": report.METRICS["contact_offset_m"]})
    assert "3.00 [1.00, 5.00] (3)" in page and "2.00 [1.00, 3.00] (2)" in page


def test_a_grid_is_gone_through_and_the_rest_drawn(tmp_path):
    campaign = load_campaign(write(tmp_path, """
name: g
runs: 3
vary:
  target.distance: {grid: [1.7, 3.0]}
  target.inclination_deg: {grid: [60.0, 90.0]}
  wind.steady.1: {uniform: [-1.0, 1.0]}
  parameters.controller.gains.lead: {choice: [0.02, 0.03]}
"""))
    assert len(campaign.runs) == 12
    points = [(r.values["target.distance"], r.values["target.inclination_deg"]) for r in campaign.runs]
    assert all(points.count(p) == 3 for p in set(points)) and len(set(points)) == 4
    run = campaign.runs[7]
    scenario = config.from_mapping(Scenario, campaign.mapping(run), "c")
    assert scenario.target.distance == run.values["target.distance"]
    assert scenario.wind.steady == (0.0, run.values["wind.steady.1"], 0.0)
    assert config.flattened(scenario.parameters["controller"])["gains.lead"] == run.values["parameters.controller.gains.lead"]
    for k in range(3):  # each point is flown under the same draws
        same = campaign.runs[4 * k:4 * k + 4]
        assert len({(r.seed, r.values["wind.steady.1"], r.values["parameters.controller.gains.lead"]) for r in same}) == 1
    assert len({r.seed for r in campaign.runs}) == 3


def test_seeds_are_no_axis_of_a_map(tmp_path):
    file = tmp_path / "seeds.yaml"
    head = "name: seeds\nruns: 1\nvary:\n  mission.replan: {grid: [true]}\n  seed: {grid: [1, 2]}\n"
    file.write_text(head)
    assert load_campaign(file).axes == ()
    file.write_text(head + "map: [mission.replan, seed]\n")
    with pytest.raises(ConfigError, match="'seed' is not varied"):
        load_campaign(file)


def test_flights_that_would_be_the_same_are_refused(tmp_path):
    file = write(tmp_path, "name: g\nruns: 3\nvary: {seed: {grid: [1, 2]}}\n")
    assert [run.seed for run in load_campaign(file, runs=1).runs] == [1, 2]
    with pytest.raises(ConfigError, match="only 2 of 6 flights differ"):
        load_campaign(file)


def test_a_flight_keeps_its_seed_whatever_is_varied(tmp_path):
    one = load_campaign(write(tmp_path, "name: g\nruns: 3\nvary: {target.distance: {uniform: [1.0, 3.0]}}\n"))
    two = load_campaign(write(tmp_path, "name: g\nruns: 3\nvary: {wind.steady.0: {uniform: [0.0, 1.0]}, target.distance: {uniform: [1.0, 3.0]}}\n"))
    assert [run.seed for run in one.runs] == [run.seed for run in two.runs]


def test_an_entry_of_a_vector_leaves_the_others_as_they_are(tmp_path):
    campaign = load_campaign(write(tmp_path, "name: g\nruns: 1\nvary: {disturbance.rotor_thrust_factor.1: {grid: [0.9]}, world.room.2: {grid: [5.0]}}\n"))
    scenario = config.from_mapping(Scenario, campaign.mapping(campaign.runs[0]), "c")
    assert scenario.disturbance.rotor_thrust_factor == (1.0, 0.9, 1.0, 1.0) and scenario.world.room == (10.0, 5.0, 5.0)


def test_more_runs_keep_the_first_ones(tmp_path):
    file = write(tmp_path, "name: g\nruns: 5\nvary: {target.distance: {uniform: [1.0, 3.0]}}\n")
    assert load_campaign(file, runs=20).runs[:5] == load_campaign(file).runs
    assert load_campaign(file, runs=20).digest != load_campaign(file).digest


@pytest.mark.parametrize("vary, words", [
    ("target.distanse: {uniform: [1.0, 2.0]}", "distanse"),
    ("target.distance: {uniform: [5.0, 6.0]}", "outside"),
    ("wind.steady.7: {uniform: [0.0, 1.0]}", "3 entries"), ("wind.gust_sigma.0: {uniform: [0.0, 1.0]}", "vary.wind.gust_sigma.0: gust_sigma is not a vector"),
    ("target: {uniform: [1.0, 2.0]}", "c.yaml: vary.target: 'target' is a group, not a value"),
    ("target.distance.far: {uniform: [1.0, 2.0]}", "c.yaml: vary.target.distance.far: 'distance' is a value, not a group"),
    ("seed: {grid: [.nan]}", "vary.seed.grid: .* are not all numbers"),
    ("seed: {grid: [1.5]}", "vary.seed: .* is not a grid or choice of whole numbers in .0, 2147483647."),
    ("seed: {grid: [one]}", "vary.seed"), ("seed: {uniform: [1, 2]}", "vary.seed"), ("seed: {choice: [-1]}", "vary.seed"),
    ("target.distance: {normal: [1.7, 0.1], low: abc}", "vary.target.distance.low: 'abc' is not a number"),
    ("target.distance: {uniform: [.nan, 2.0]}", "vary.target.distance.uniform"), ("target.distance: {normal: [1.7, .inf]}", "normal"),
    (", ".join(f"parameters.vio.a{k}: {{grid: [{', '.join('1' * 100)}]}}" for k in range(4)), "runs: 10000000000 flights .* are more than 20000"),
    ("parameters.controller.gains.laed: {grid: [0.1]}", "parameters.controller.gains.laed: unknown"),
    ("parameters.controller.gains.lead: {uniform: [0.01, 9.0]}", "parameters.controller.gains.lead: .* is outside"),
    ("parameters.pilot.a: {grid: [1]}", "parameters.pilot"), ("vehicle: {grid: [nothing]}", "vehicle: 'nothing': unknown"),
])
def test_what_no_scenario_accepts_is_refused_before_the_first_flight(tmp_path, vary, words):
    with pytest.raises(ConfigError, match=words):
        load_campaign(write(tmp_path, f"name: g\nvary: {{{vary}}}\n"))


def touch(state, body="pad", normal=0.5, tangential=0.1, tilt=3.0, reason=""):
    return Contact(5_000_000_000, state, body, normal, tangential, math.radians(tilt), 0.02, reason)


GROUND, NONE = touch(ContactState.GROUND, "floor"), touch(ContactState.NONE, "floor")
ATTACHED, BOUNCED, COLLISION = ContactState.ATTACHED, ContactState.BOUNCED, ContactState.COLLISION


@pytest.mark.parametrize("outcome, touches, cause", [
    ("perched", [touch(ATTACHED)], "perched"),
    ("perched", [], "came_off"),
    ("perched", [touch(ATTACHED), touch(ContactState.NONE)], "came_off"),
    ("inspected", [], "perched"),
    ("inspected", [touch(COLLISION, "cable 0", reason="crashed: a cable in the rotors")], "crash"),
    ("not_found", [], "not_found"),
    ("refused", [], "refused"),
    ("timeout", [], "timeout"),
    ("tracking_lost", [], "lost_track"),
    ("missed", [], "missed_pad"),
    ("missed", [touch(BOUNCED, normal=1.4, reason="normal speed")], "too_fast"),
    ("missed", [touch(BOUNCED, tangential=0.9, reason="tangential speed")], "too_fast"),
    ("missed", [touch(BOUNCED, normal=0.05, reason="normal speed")], "too_slow"),
    ("missed", [touch(BOUNCED, tilt=22.0, reason="tilt error")], "tilt"),
    ("missed", [touch(BOUNCED, tilt=22.0, reason="touched 0.1 m outside the pad; tilt error")], "missed_pad"),
    ("missed", [touch(COLLISION, reason="a rotor touched the pad")], "crash"),
    ("crashed", [touch(COLLISION, "floor", reason="crashed: touched the floor tilted by 80 deg")], "crash"),
    ("crashed", [touch(BOUNCED, tilt=30.0, reason="tilt error"), touch(COLLISION, "floor", reason="crashed: floor")], "tilt"),
])
def test_causes_come_from_the_first_thing_that_went_wrong(outcome, touches, cause):
    assert cause_of(outcome, [GROUND, NONE, *touches], Scenario(name="s")) == cause


@pytest.mark.parametrize("values, grip, cause", [
    (dict(offset=0.16), {}, "missed_pad"), (dict(speed=0.6), {}, "too_fast"), (dict(tilt=20.0), {}, "tilt"), (dict(offset=0.16, speed=0.5), {}, "missed_pad"),
    (dict(), {"enabled": False}, "missed_pad"), (dict(speed=0.6), {"speed": 1.0, "position": 0.01}, "missed_pad")])
def test_a_missed_cable_is_judged_by_the_limits_of_the_gripper(values, grip, cause):
    """By those of the velcro, 0.6 m/s is neither too fast nor 16 cm too far."""
    values = {"offset": 0.04, "speed": 0.05, "tilt": 2.0} | values
    missed = Contact(5_000_000_000, BOUNCED, "cable 0", values["speed"], 0.0, math.radians(values["tilt"]), values["offset"], "missed")
    assert cause_of("missed", [GROUND, NONE, missed], config.from_mapping(Scenario, {"name": "line", "grip": grip}, "s")) == cause


def test_results_outlive_the_writer_and_are_read_while_it_writes(tmp_path):
    path = tmp_path / "r.jsonl"
    results = Results(path, "c", "digest", resume=False)
    for n in (3, 1, 2, 1):
        results.add(RunResult(n, 10 + n, "perched", "perched", "", {"a": 1.5}, {"x": None, "y": 2.0}))
    assert [r.number for r in read_results(path)[1]] == [1, 2, 3]
    del results  # never closed, as after SIGKILL
    assert read_results(path)[1][0].metrics == {"x": None, "y": 2.0}
    with pytest.raises(ResultsError, match="--resume"):
        Results(path, "c", "digest", resume=False)
    with pytest.raises(ResultsError, match="other settings"):
        Results(path, "c", "another", resume=True)
    assert [r.number for r in Results(path, "c", "digest", resume=True).all()] == [1, 2, 3]


def test_a_row_that_was_cut_off_does_not_count_and_is_flown_again(tmp_path):
    path = tmp_path / "r.jsonl"
    with closing(Results(path, "c", "digest", resume=False)) as results:
        for n in range(3):
            results.add(RunResult(n, n, "perched", "perched", ""))
    path.write_bytes(path.read_bytes()[:-20])
    with closing(Results(path, "c", "digest", resume=True)) as results:
        assert [r.number for r in results.all()] == [0, 1]
        results.add(RunResult(2, 2, "perched", "perched", ""))
    assert [r.number for r in read_results(path)[1]] == [0, 1, 2]


def test_runs_that_could_not_be_carried_out_are_flown_again(tmp_path, monkeypatch):
    specification, path, flown, cause = load_campaign(write(tmp_path, "name: c\nruns: 2\n")), tmp_path / "r.jsonl", [], "error"

    def in_pool(tasks, jobs):
        for task in tasks:
            flown.append(task.run.number)
            yield RunResult(task.run.number, task.run.seed, cause if task.run.number else "perched", "", "OSError: No space left on device")

    monkeypatch.setattr(campaign, "in_pool", in_pool)
    for cause in ("error", "perched", "perched"):
        with closing(Results(path, "c", "digest", resume=True)) as results:
            campaign.fly_all(specification, results, 1, None)
    assert flown == [0, 1, 1] and [r.cause for r in read_results(path)[1]] == ["perched", "perched"]


def test_results_are_resumed_with_the_same_vehicle_and_code_only(tmp_path, monkeypatch, capsys):
    def interrupted(*_):
        raise KeyboardInterrupt

    vehicle, file = tmp_path / "v.yaml", tmp_path / "s.yaml"
    file.write_text(f"extends: surface_90\nvehicle: {vehicle}\n")
    specification = write(tmp_path, f"name: c\nscenario: {file}\nruns: 1\n")
    monkeypatch.setattr(campaign, "fly_all", interrupted)
    for mass, code, end in ((0.25, "0123", 130), (0.25, "0123", 130), (0.35, "0123", 2), (0.25, "4567", 2)):
        vehicle.write_text(f"extends: snapdragon\nmass: {mass}\n")
        monkeypatch.setattr(campaign, "digest", lambda: code)
        assert campaign.main([str(specification), "--out", str(tmp_path / "out"), "--resume"]) == end
        assert ("other settings or code" in capsys.readouterr().err) == (end == 2)


def test_flights_of_a_campaign_whose_results_are_gone_are_not_taken_for_those_of_the_next_one(tmp_path, capsys):
    report = tmp_path / "flights" / "run_00000" / "report.html"
    report.parent.mkdir(parents=True)
    report.write_text("another flight")
    for arguments in ([], ["--resume"]):
        assert campaign.main(["contact", "--runs", "1", "--out", str(tmp_path), *arguments]) == 2
        assert f"error: {tmp_path / 'flights'} holds flights of an earlier campaign" in capsys.readouterr().err
    assert report.read_text() == "another flight" and not (tmp_path / "results.jsonl").exists()


def test_results_are_resumed_with_the_same_own_engine_only(tmp_path, monkeypatch, capsys):
    engine = tmp_path / "engine_of_a_campaign.py"
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(campaign, "digest", lambda: "0123")
    monkeypatch.setattr(campaign, "fly_all", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
    for text, end in (("fly = 1", 130), ("fly = 1", 130), ("fly = 2", 2)):
        engine.write_text(text)
        assert campaign.main(["contact", "--engine", "engine_of_a_campaign:fly", "--runs", "1", "--out", str(tmp_path / "out"), "--resume"]) == end
        assert ("other settings or code" in capsys.readouterr().err) == (end == 2)


@pytest.mark.parametrize("damage", [
    "folder", b"no results at all\n" * 100, b"\xff\n", b"[" * 100_000 + b"\n", {"values": None}, {"metrics": [1]}, {"seed": "x"},
    {"metrics": {"a": []}}, {"more": 1}])
def test_results_that_make_no_sense_are_refused_in_one_line_and_left_as_they_are(tmp_path, capsys, damage):
    path = tmp_path / "results.jsonl"
    if damage == "folder":
        path.mkdir()
    else:
        with closing(Results(path, "c", "digest", resume=False)) as results:
            results.add(RunResult(1, 1, "perched", "perched", ""))
        whose, row = path.read_bytes().splitlines(keepends=True)
        path.write_bytes(whose + (damage if isinstance(damage, bytes) else json.dumps(json.loads(row) | damage).encode() + b"\n"))
    with pytest.raises(ResultsError, match="results.jsonl cannot be read as results"):
        read_results(path)
    before = None if path.is_dir() else path.read_bytes()
    assert campaign.main(["contact", "--out", str(tmp_path), "--resume"]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"error: {path} ") and len(said.splitlines()) == 1
    assert path.is_dir() or path.read_bytes() == before


@pytest.mark.parametrize("folder", ["file", "file/below", "/proc/flights"])
def test_a_folder_that_cannot_be_written_is_refused_before_anything_is_flown(tmp_path, monkeypatch, capsys, folder):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    for main, arguments in ((campaign.main, ["contact"]), (evaluation.main, ["--only", "m_planning"]), (demo.main, [])):
        assert main([*arguments, "--out", folder]) == 2
        said = capsys.readouterr()
        assert said.out == "" and said.err.startswith(f"error: --out: {folder}: cannot be written: ") and len(said.err.splitlines()) == 1


def test_the_worst_flights_show_every_cause():
    found = [RunResult(n, n, cause, "", "", metrics={"contact_tilt_error_deg": float(n)})
             for n, cause in enumerate(["tilt"] * 5 + ["crash"] * 2 + ["perched"] * 3 + ["error"])]
    assert [r.number for r in worst(found, 4)] == [4, 6, 3, 5]
    assert [r.cause for r in worst(found, 9)][-2:] == ["perched", "perched"]


def test_every_value_has_its_cell():
    values = list(np.linspace(0.0, 3.0, 40))
    _, cells = cells_of([0.0, 0.51, 2.99, 3.0, *values])
    assert cells[:4].tolist() == [0, 1, 5, 5]
    assert cells_of([False, True, True])[1].tolist() == [0, 1, 1]
    assert cells_of(["a", "b"])[0] == ["a", "b"]


@pytest.mark.parametrize("k, n", [(0, 10), (4, 5), (95, 100), (100, 100), (3, 7)])
def test_the_interval_is_that_of_the_score_test(k, n):
    """At its ends the share that was seen is 1.96 standard deviations from the rate (Wilson 1927)."""
    for p, outermost in zip(Rate(k, n).interval, (0.0, 1.0)):
        assert abs(k / n - p) == pytest.approx(1.959964 * np.sqrt(p * (1.0 - p) / n), abs=1e-6) if p != outermost else k == n * outermost


@pytest.mark.parametrize("k, n, share, shown", [(0, 0, 0.95, None), (1, 1, 0.95, None), (72, 72, 0.95, None), (73, 73, 0.95, True), (35, 35, 0.9, True),
                                                (19, 20, 0.95, None), (95, 100, 0.95, True), (94, 100, 0.95, False), (0, 5, 0.95, False)])
def test_few_trials_do_not_show_a_share_but_may_refute_it(k, n, share, shown):
    assert Rate(k, n).at_least(share) is shown


def test_a_rate_counts_outcomes():
    assert Rate.from_outcomes(k % 4 == 0 for k in range(10)) == Rate(3, 10) and Rate.from_outcomes([]) == Rate(0, 0)


def test_spread_leaves_out_what_is_no_number():
    spread = Spread.from_values([3.0, None, 1.0, float("nan"), 2.0])
    assert (spread.median, spread.low, spread.high, spread.count) == (2.0, 1.0, 3.0, 3)
    assert Spread.from_values([]).to_text() == "-"


def test_a_run_leaves_the_other_cores_to_other_runs():
    before = cv2.getNumThreads()
    try:
        cv2.setNumThreads(2)
        result = run_task(Task(Run(0, 1, {}), {}, "no_such_engine", {}))
        assert (result.outcome, cv2.getNumThreads()) == ("failed", 1)
    finally:
        cv2.setNumThreads(before)


@pytest.mark.parametrize("broken_at", range(1, 13))
def test_a_run_that_a_broken_pool_refuses_goes_on_waiting(monkeypatch, broken_at):
    """A worker's death is noticed in between two calls, so that `submit` is what says so."""
    submitted = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, jobs, mp_context, initializer):
            super().__init__(jobs)

        def submit(self, function, work, task):
            submitted.append(task)
            if len(submitted) == broken_at:
                raise BrokenProcessPool
            return super().submit(function, work, task)

    monkeypatch.setattr(workers, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(workers, "run_task", lambda task: RunResult(task.run.number, task.run.seed, "perched", "perched", ""))
    tasks = [Task(Run(n, 0, {}), {}, "", "") for n in range(12)]
    assert {r.number for r in workers.in_pool(tasks, 2)} == set(range(12))


@pytest.fixture
def dying(monkeypatch):
    """The items of each pool, of one that breaks as soon as it has the item `poison`."""
    pools = []

    class Pool:
        def __init__(self, jobs, mp_context, initializer):
            pools.append([])

        def submit(self, function, work, item):
            pools[-1].append(item)
            future = Future()
            future.item = item
            return future

        def shutdown(self, wait, cancel_futures):
            pass

    def wait(pending, return_when):
        for future in pending:
            if any(other.item == "poison" for other in pending):
                future.set_exception(BrokenProcessPool())
            else:
                future.set_result(future.item.upper())
        return SimpleNamespace(done=list(pending))

    monkeypatch.setattr(workers, "ProcessPoolExecutor", Pool)
    monkeypatch.setattr(workers, "wait", wait)
    return pools


def test_an_item_at_which_workers_die_costs_no_other_its_result(dying):
    found = dict(workers.in_processes(str.upper, ["a", "b", "poison", "c", "d", "e"], 2, lambda item: "given up"))
    assert found == {"a": "A", "b": "B", "poison": "given up", "c": "C", "d": "D", "e": "E"}
    assert dying.count(["poison"]) == workers.ATTEMPTS


def test_the_item_at_which_workers_die_is_named(dying):
    with pytest.raises(PerchError, match="a process has died 3 times at poison"):
        list(workers.in_processes(str.upper, ["a", "b", "poison", "c"], 2))


def test_work_in_processes_ends_with_whoever_waits_for_it(monkeypatch):
    ended = []

    class Pool(ThreadPoolExecutor):
        def __init__(self, jobs, mp_context, initializer):
            super().__init__(jobs)

        def shutdown(self, wait=True, *, cancel_futures=False):
            ended.append(wait)
            super().shutdown(wait, cancel_futures=cancel_futures)

    monkeypatch.setattr(workers, "ProcessPoolExecutor", Pool)
    assert dict(workers.in_processes(abs, [-7, 9], 1)) == {-7: 7, 9: 9}
    interrupted = workers.in_processes(abs, [-7, 9], 1)
    next(interrupted)
    interrupted.close()  # as an exception of the caller does
    assert ended == [True, False]
