"""The registry of missions: a scenario names one, and the goal of the action carries it."""

import re
from dataclasses import replace
from pathlib import Path

import pytest
from perch_control.mission.missions import MISSIONS, mission_class
from perch_core.errors import ConfigError
from perch_eval.flyable import check_names
from perch_eval.goal import goal_of
from perch_msgs.action import Perch
from perch_sim.scenario import load_scenario

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "own_mission.md"


@pytest.fixture
def near(tmp_path, monkeypatch):
    """The scenario of the guide, with its mission in the registry by the guide's line."""
    text = GUIDE.read_text()
    for name, block in re.findall(r"```(?:py|yaml)\n# (?:scenario )?(\S+)\n(.*?)```", text, re.S):
        (tmp_path / name).write_text(block)
    monkeypatch.syspath_prepend(tmp_path)
    name, place = re.search(r'^"(\w+)": "([\w:.]+)",$', text, re.M).groups()
    monkeypatch.setitem(MISSIONS, name, place.removeprefix("perch_control.mission."))  # here the file is on the path
    return load_scenario(tmp_path / "near.yaml")


def test_the_modes_are_those_of_the_action():
    assert list(MISSIONS) == ["surface", "powerline", "inspection"]
    assert [Perch.Goal.MODE_SURFACE, Perch.Goal.MODE_POWERLINE, Perch.Goal.MODE_INSPECTION] == [0, 1, 2]
    assert [goal_of(load_scenario(name)).mode for name in ("surface_60", "line_80", "inspection")] == [0, 1, 2]


def test_the_mission_of_the_guide_is_that_of_its_scenarios_goal(near):
    """That it flies is shown in `test_eval_howto.py`."""
    check_names(near, "near.yaml")
    mode = goal_of(near).mode
    assert mode == 3 and mission_class(mode).__name__ == "NearMission"


def test_a_mission_that_does_not_exist_is_refused_with_those_that_do(near, monkeypatch):
    wrong = replace(near, mission=replace(near.mission, type="nearer"))
    with pytest.raises(ConfigError, match="near.yaml: mission.type: 'nearer' is not one of surface, powerline, inspection, near"):
        check_names(wrong, "near.yaml")
    with pytest.raises(ConfigError, match="mission.type: 'nearer' is not one of"):
        goal_of(wrong)
    monkeypatch.setitem(MISSIONS, "near", "near_mission:Missing")
    with pytest.raises(ConfigError, match="no 'Missing'"):
        check_names(near, "near.yaml")
