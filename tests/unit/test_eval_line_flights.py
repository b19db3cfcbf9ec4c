"""Errors at the perching point of a flown powerline perch, against a flight whose errors are known."""

from dataclasses import asdict

import numpy as np
import pytest

from perch_core import so3
from perch_core.trajectory import SampledTrajectory
from perch_core.values import AtEnd, Contact, MappedPowerline, PowerlineMap, TrajectoryOrder, nanoseconds
from perch_eval.campaign.results import RunResult
from perch_eval.evaluation import kept, powerline
from perch_eval.evaluation.document import FAILS, HOLDS, SHOWN, VACUOUS, Effort
from perch_eval.evaluation.powerline import POSITION, flown_sections, hovers_at_end, mapping_errors, perching_errors
from perch_eval.flight import Flight, States
from perch_sim.scenario import Cable, Mission, Scenario, World

OFFSET, TILT = np.array([0.01, -0.02, 0.02]), np.radians(4.0)  # of the flown from the planned: 3 cm, 4 deg


def contact(time: float, state: int) -> tuple[float, Contact]:
    """A touch with its time."""
    return time, Contact(nanoseconds(time), state, "", 0.0, 0.0, 0.0, 0.0, "")


class Flown(Flight):
    """A flight made here: the plan, shifted and tilted, and flown to `end`; the odometry is off by `drift`."""

    drift = np.zeros(3)

    def __init__(self, end: float, touch: float | None = None) -> None:
        times = np.linspace(0.0, 3.0, 31)
        p = np.stack([times, np.zeros(31), 2.0 + 0.1 * times], axis=1)
        q = so3.quat_exp(np.stack([np.zeros(31), 0.4 * times, np.zeros(31)], axis=1))
        zero = np.zeros((31, 3))
        plan = SampledTrajectory(times, p, q, np.gradient(p, times, axis=0), zero, zero, zero, np.ones((31, 4)), 10.0)
        self.made = {"trajectory": [(9.0, TrajectoryOrder(1, plan, AtEnd.RECOVER, recovery_start=2.0))]}
        if touch is not None:
            self.made["contact"] = [contact(1.0, 4), contact(2.0, 0), contact(touch, 1)]
        super().__init__(self.made)
        t = np.linspace(0.0, end - 10.0, 400)
        turn = so3.quat_exp(np.array([0.0, TILT, 0.0]))
        nearest = so3.quat_exp(np.stack([0 * t, 0.4 * t, 0 * t], axis=1))
        self._truth = States(10.0 + t, np.stack([t, 0 * t, 2.0 + 0.1 * t], axis=1) + OFFSET, so3.quat_multiply(nearest, turn),
                             np.zeros((400, 3)), np.zeros((400, 3)))

    def states(self, topic):
        x = self._truth
        return x if topic == "ground_truth/odometry" else States(x.t, x.p + self.drift, x.q, x.v, x.w)


def scenario(y: float = 0.0, z: float = 0.0) -> Scenario:
    """One wire, along x, that passes `y`, `z` beside where the plan has it, and another one far away."""
    b3 = np.array([np.sin(0.8), 0.0, np.cos(0.8)])
    x, _, height = np.array([2.0, 0.0, 2.2]) - 0.15 * b3  # the gripper at the end of the plan
    return Scenario(name="line", mode="powerline", vehicle="rpg", mission=Mission(perch_point=(x, 0.0, height)), world=World(cables=(
        Cable(start=(-3.0, 3.0, 3.0), end=(8.0, 3.0, 3.0)), Cable(start=(-3.0, y, height + z), end=(8.0, y, height + z)))))


@pytest.mark.parametrize("touch", [None, 11.6, 12.5])
def test_errors_are_those_that_were_put_in(touch):
    found = perching_errors(Flown(12.8, touch), scenario(), 0.15)
    assert found["perching_in_map_m"] == pytest.approx(0.03, abs=1e-6)
    assert found["perching_position_m"] == pytest.approx(np.hypot(0.02, 0.02), abs=1e-6), "across the wire"
    assert found["perching_tilt_deg"] == pytest.approx(4.0, abs=0.3)  # the attitude is that of the nearest sample


def test_a_wire_elsewhere_is_an_error_and_a_drift_with_the_wire_is_none():
    found = perching_errors(Flown(12.8), scenario(y=0.03), 0.15)
    assert found["perching_position_m"] == pytest.approx(np.hypot(0.05, 0.02), abs=1e-6)
    found = perching_errors(Flown(12.8), scenario(y=-0.02, z=0.02), 0.15)
    assert found["perching_position_m"] == pytest.approx(0.0, abs=1e-6)


def test_the_map_is_judged_in_map_and_as_the_vehicle_sees_it():
    flight, where = Flown(12.8), scenario()
    _, y, z = where.mission.perch_point
    lines = tuple(MappedPowerline(1, (-1.0, k, z + k), (5.0, k, z + k), 0.01, np.zeros((3, 3)), 0.0, 1) for k in (0.03, 1.0))
    flight.made["powerlines"] = [(7.9, PowerlineMap(nanoseconds(10.5), lines, False, "")),
                                 (8.9, PowerlineMap(nanoseconds(10.5), lines[1:], False, ""))]  # after the request, 1.04 s before the start
    found = mapping_errors(flight, where)
    assert found["mapping_in_map_m"] == pytest.approx(np.hypot(0.03, 0.03), abs=1e-6)
    drift = np.array([0.0, 0.04, 0.02])
    flight.drift = drift
    assert mapping_errors(flight, where)["mapping_m"] == pytest.approx(np.hypot(0.01, 0.01), abs=1e-6)


def test_a_flight_that_ends_before_the_perch_has_no_errors():
    assert set(perching_errors(Flown(11.5), scenario(), 0.15).values()) == {None}


def test_a_crash_on_the_way_is_no_error_at_the_perch():
    flight = Flown(12.8)
    flight.made["contact"] = [contact(1.0, 4), contact(2.0, 0), contact(11.6, 3)]
    assert set(perching_errors(flight, scenario(), 0.15).values()) == {None}


@pytest.fixture(autouse=True)
def unchanged_code(monkeypatch):
    """Each stored flight would read all code again, to see that it is still the same; `test_eval_evaluation.py` shows what comes of a change."""
    monkeypatch.setattr(kept, "require_code", lambda *_: None)


def effort(tmp_path, seeds: int) -> Effort:
    return Effort(True, 1, tmp_path, tmp_path, "evaluate.py", seeds=range(1, 2), seeds_on_lines=range(1, 1 + seeds), layouts=1,
                  code={"commit": "1234567", "digest": "0123456789ab"})


def test_a_hover_at_the_end_is_slow_high_and_free_of_the_wire():
    flight = Flown(13.0)
    x = flight._truth
    assert hovers_at_end(flight)
    for p, v in ((x.p, x.v + 0.5), (x.p * (1.0, 1.0, 0.05), x.v)):
        flight._truth = States(x.t, p, x.q, v, x.w)
        assert not hovers_at_end(flight)
    assert not hovers_at_end(Flown(13.0, touch=12.0))


def test_some_scenarios_are_flown_without_a_grip_as_well_and_keep_their_numbers_when_seeds_are_added(tmp_path, monkeypatch):
    handed = []

    def pool(work, tasks, jobs, dead):
        for task in tasks:
            handed.append(task)
            yield task, asdict(RunResult(task.run.number, task.run.seed, "perched", "perched", "", task.run.values))

    monkeypatch.setattr(kept, "in_processes", pool)
    found = powerline.flights(effort(tmp_path, 2), ("line_80_pa", "line_180"))
    assert {key: [r.seed for r in runs] for key, runs in found.items()} == {
        ("line_80_pa", True): [1, 2], ("line_80_pa", False): [], ("line_180", True): [1, 2], ("line_180", False): [1, 2]}
    assert all(task.scenario.get("grip", {}).get("enabled", True) == task.run.values["grips"] for task in handed)
    found = powerline.flights(effort(tmp_path, 5), ("line_80_pa", "line_180"))
    assert [r.seed for r in found["line_180", False]] == [1, 2, 3] and [r.seed for r in found["line_180", True]] == [1, 2, 3, 4, 5]
    assert len(handed) == len({task.run.number for task in handed}) == 13, "nothing is flown twice"


@pytest.mark.parametrize("outcome, message, hovers, verdict", [("missed", "no adhesion; recovered to a hover", 1.0, HOLDS),
                                                               ("missed", "no adhesion; recovered to a hover", 0.0, FAILS),
                                                               ("failed", "crashed: a cable in the rotors", 0.0, FAILS)])
def test_a_flight_without_a_grip_must_end_in_a_hover(tmp_path, monkeypatch, outcome, message, hovers, verdict):
    def pool(work, tasks, jobs, dead):
        for task in tasks:
            end = ("perched", "perched", "") if task.run.values["grips"] else ("missed_pad", outcome, message)
            errors = {"perching_position_m": 0.01, "perching_tilt_deg": 1.0, "hovers_at_end": hovers}
            yield task, asdict(RunResult(task.run.number, task.run.seed, *end, task.run.values, errors))

    monkeypatch.setattr(kept, "in_processes", pool)
    [section] = flown_sections(effort(tmp_path, 1))
    rows = {row.name: row for row in section.rows}
    assert rows["180 deg, grip switched off: recoveries to a hover"].verdict == verdict
    assert rows["180 deg: recoveries to a hover"].verdict == VACUOUS, "all gripped"
    assert rows["180 deg: gripped the cable"].ours.startswith("1/1")
    assert "80 deg, perception-aware, grip switched off: recoveries to a hover" not in rows


@pytest.mark.parametrize("in_map, verdict", [(0.03, HOLDS), (0.044, FAILS)])
def test_the_papers_tracking_error_is_judged_by_the_true_place_against_the_planned_one(tmp_path, monkeypatch, in_map, verdict):
    """Across the wire and without the odometry's drift, all are well within the paper's 3.1 cm."""
    errors = {"perching_position_m": 0.017, "perching_in_map_m": in_map, "perching_tilt_deg": 1.0}
    runs = [RunResult(1, 1, "perched", "perched", "", {"scenario": "line_80", "grips": True}, errors)]
    monkeypatch.setattr(powerline, "flights", lambda effort, cases: {
        (case, grips): runs if (case, grips) == ("line_80", True) else [] for case in cases for grips in (True, False)})
    [section] = flown_sections(effort(tmp_path, 1))
    rows = {row.name: row for row in section.rows}
    assert rows[f"80 deg: {POSITION}"].verdict == verdict and f"{100 * in_map:.1f} cm" in rows[f"80 deg: {POSITION}"].ours
    across = rows["80 deg: position across the wire, without drift"]
    assert across.verdict == SHOWN and across.ours.startswith("1.7") and not across.paper


def test_errors_of_flights_that_never_came_to_the_line_fail(tmp_path, monkeypatch):
    def pool(work, tasks, jobs, dead):
        yield from ((task, asdict(RunResult(task.run.number, task.run.seed, "not_found", "not_found", "no map", task.run.values))) for task in tasks)

    monkeypatch.setattr(kept, "in_processes", pool)
    [section] = flown_sections(effort(tmp_path, 2))
    rows = {row.name: row for row in section.rows}
    for name in (f"80 deg: {POSITION}", "80 deg: pitch-roll RMSE", "80 deg: mapping"):
        assert rows[name].verdict == FAILS and "(0 of 2 flights)" in rows[name].ours
    contacts = rows["80 deg: contacts with other lines"]
    assert contacts.verdict == FAILS and contacts.ours == "0 (0 of 4 flights)", "not carried out, they touched nothing"
