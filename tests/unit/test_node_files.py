"""`config/<node>.yaml`: a node that is started without its file flies the same settings."""

from __future__ import annotations

import dataclasses

import pytest
from perch_core import config
from perch_core.ros import parameters
from perch_eval.in_process.parameters import COMPONENTS, component_class

FILES = {name: config.config_dir() / f"{name}.yaml" for name in COMPONENTS}


@pytest.mark.parametrize("name", [name for name, file in FILES.items() if file.exists()])
def test_its_values_are_the_defaults(name):
    shipped = config.flattened(config.read_yaml(FILES[name])["/**"]["ros__parameters"])
    shipped.pop("lockstep", None)  # of the host, not of the component
    defaults = config.flattened(dataclasses.asdict(component_class(name, {}).config_type()))
    assert shipped == {key: defaults[key] for key in shipped}


@pytest.mark.parametrize("name", COMPONENTS)
def test_each_parameter_says_what_it_is(name):
    leaves = parameters._leaves(component_class(name, {}).config_type)
    assert not [leaf for leaf, (field, _) in leaves.items() if not field.metadata.get("doc")]
