"""A law that takes long to build: what is changed meanwhile counts, and a build that failed is tried again with other parameters."""

from __future__ import annotations

from dataclasses import replace

import pytest

from perch_control.assembly import Assembly, LawNotReady
from perch_control.parameters import ControllerChoice, ControllerParameters
from perch_core.errors import ConfigError, PerchError
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
