"""`config/<node>.yaml`: a node that is started without its file flies the same settings."""

from __future__ import annotations

import dataclasses
import typing

import pytest
from perch_core import config
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
    def silent(cls: type, prefix: str = "") -> list[str]:
        kinds, out = typing.get_type_hints(cls), []
        for field in config.settable(cls):
            if dataclasses.is_dataclass(kinds[field.name]):
                out += silent(kinds[field.name], f"{prefix}{field.name}.")
            elif not field.metadata.get("doc"):
                out.append(prefix + field.name)
        return out

    assert not silent(component_class(name, {}).config_type)
