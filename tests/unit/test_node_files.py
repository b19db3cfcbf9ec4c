"""`config/<node>.yaml`: a node that is started without its file flies the same settings."""

from __future__ import annotations

import dataclasses

import pytest
from perch_core import config
from perch_eval.in_process.parameters import COMPONENTS, component_class

FILES = {name: config.config_dir() / f"{name}.yaml" for name in COMPONENTS}


def values(settings, prefix=""):
    """What can be set, by dotted name."""
    found = {}
    for field in config.settable(type(settings)):
        value, name = getattr(settings, field.name), f"{prefix}{field.name}"
        found |= values(value, f"{name}.") if dataclasses.is_dataclass(value) else {name: value}
    return found


@pytest.mark.parametrize("name", [name for name, file in FILES.items() if file.exists()])
def test_its_values_are_the_defaults(name):
    shipped = config.flattened(config.read_yaml(FILES[name])["/**"]["ros__parameters"])
    shipped.pop("lockstep", None)  # of the host, not of the component
    defaults = values(component_class(name, {}).config_type())
    own = {key: list(value) if isinstance(value, tuple) else value for key, value in defaults.items()}
    assert shipped == {key: own[key] for key in shipped}
