"""Scenarios of these flights."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from perch_core import config
from perch_sim.scenario import Scenario
from perch_sim.scenario_files import scenario_mapping

EVERY_STEP = {"controller.reference_period": 0.002}
"""Parameter of the controller: its reference is judged at every step."""


def scenario_of(name: str, changes: Mapping[str, Any], controller: Mapping[str, Any]) -> Scenario:
    """A scenario with changes, and parameters of the controller in the place of its own."""
    mapping = {**scenario_mapping(name), "parameters": {"controller": {**EVERY_STEP, **controller}}, **changes}
    return config.from_mapping(Scenario, mapping, name)
