"""A law that takes long to build: what is changed meanwhile counts, and with other parameters it is built again, also after a failure."""

from __future__ import annotations

from dataclasses import replace

import pytest

from perch_control.assembly import Assembly, LawNotReady
from perch_control.geometric import GeometricController
from perch_control.laws import LAWS
from perch_control.modes import State
from perch_control.parameters import ControllerChoice, ControllerParameters
from perch_core.errors import ConfigError, PerchError
from perch_core.job import run_now
from perch_core.vehicle import load_vehicle

PARAMETERS = ControllerParameters()
CHANGED = replace(PARAMETERS, nmpc=replace(PARAMETERS.nmpc, horizon=0.5))


def prepared() -> tuple[Assembly, list, list[str]]:
    """An assembly that has begun to build its slow laws, the jobs that do so, and what it says."""
    assembly, jobs, said = Assembly(PARAMETERS, load_vehicle("snapdragon")), [], []
    assembly.prepare_slow_laws(jobs.append, said.append)
    return assembly, jobs, said


def test_a_build_that_fails_with_parameters_that_were_changed_meanwhile_is_tried_with_the_new_ones():
    assembly, jobs, said = prepared()
    assembly.change(CHANGED)
    jobs.pop().then(PerchError("no such horizon"))
    assert said == [] and jobs.pop().arguments[2] is CHANGED
    with pytest.raises(LawNotReady, match="being built"):
        assembly.choose("nmpc", False)


def test_a_build_that_failed_says_so_at_each_door_and_is_tried_again_with_other_parameters():
    assembly, jobs, said = prepared()
    jobs.pop().then(PerchError("no compiler"))
    assert said == ["nmpc could not be built: no compiler"]
    with pytest.raises(LawNotReady, match="no compiler"):
        assembly.choose("nmpc", False)
    with pytest.raises(ConfigError, match="no compiler"):
        assembly.change(replace(PARAMETERS, controller=ControllerChoice(type="nmpc")))
    assembly.change(CHANGED)
    assert jobs.pop().arguments[2] is CHANGED
    with pytest.raises(LawNotReady, match="being built"):
        assembly.choose("nmpc", False)


class Own(GeometricController):
    """A law of one's own that takes long to build, and does not say how to take new parameters."""

    name, slow = "own", True


def own() -> tuple[Assembly, list]:
    """An assembly that has built `Own`, and the jobs that it submits from then on."""
    assembly, jobs, _ = prepared()
    while jobs:
        job = jobs.pop()
        if job.arguments[0] == "own":
            run_now(job)
    return assembly, jobs


def test_a_slow_law_that_cannot_be_changed_is_built_again(monkeypatch):
    monkeypatch.setitem(LAWS, "own", f"{__name__}:Own")
    assembly, jobs = own()
    assembly.change(CHANGED)
    with pytest.raises(LawNotReady, match="being built"):
        assembly.choose("own", False)
    job = jobs.pop()
    assert job.arguments[::2] == ("own", CHANGED) and not jobs
    run_now(job)
    assembly.choose("own", False)
    assert assembly.active_law == "own"


def test_a_slow_law_in_use_is_not_built_again_in_flight(monkeypatch):
    monkeypatch.setitem(LAWS, "own", f"{__name__}:Own")
    assembly, jobs = own()
    assembly.choose("own", False)
    assembly.change(CHANGED)  # on the ground it is, at once
    law, assembly.flight.flight_state = assembly.flight.law, assembly.flight.flight_state._replace(mode=State.HOVERING)
    for params in (PARAMETERS, replace(PARAMETERS, controller=ControllerChoice(adaptive=True))):
        with pytest.raises(ConfigError, match="own takes long to be built with other parameters: not in flight"):
            assembly.change(params)
        assert assembly.flight.law is assembly.laws["own"] is law
    assembly.choose("geometric", False)
    assembly.change(PARAMETERS)
    assert assembly.active_law == "geometric" and [job.arguments[::2] for job in jobs] == [("own", PARAMETERS)]


def test_a_slow_law_can_be_left_in_flight_by_a_parameter(monkeypatch):
    monkeypatch.setitem(LAWS, "own", f"{__name__}:Own")
    assembly, jobs = Assembly(replace(PARAMETERS, controller=ControllerChoice(type="own")), load_vehicle("snapdragon")), []
    assembly.prepare_slow_laws(lambda job: jobs.append(job.arguments[::2]), print)
    assembly.flight.flight_state = assembly.flight.flight_state._replace(mode=State.HOVERING)
    assembly.change(CHANGED)
    assert assembly.active_law == "geometric" and jobs[-1] == ("own", CHANGED)
