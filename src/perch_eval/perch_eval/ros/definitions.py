"""Message types by name, and their definitions in the form that MCAP and Foxglove require."""

from __future__ import annotations

import re
from functools import lru_cache
from importlib import import_module
from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from perch_eval.mcap_log import Schema


def type_name(msg_type: type) -> str:
    """`package/msg/Name` of a message class."""
    package, kind, *_ = msg_type.__module__.split(".")
    return f"{package}/{kind}/{msg_type.__name__}"


@lru_cache(maxsize=None)
def schema_of(msg_type: type) -> Schema:
    """Name and definition of a message class."""
    name = type_name(msg_type)
    return Schema(name, message_definition(name))


def message_definition(name: str) -> str:
    """Return the definition of a type followed by those of the types it contains, in MCAP's `ros2msg` form."""
    seen: dict[str, str] = {}

    def collect(full: str) -> None:
        package, kind, short = full.split("/")
        if full in seen:
            return
        seen[full] = (Path(get_package_share_directory(package)) / kind / f"{short}.msg").read_text()
        fields = getattr(import_module(f"{package}.{kind}"), short).get_fields_and_field_types()
        for inner_package, inner in re.findall(r"(\w+)/(\w+)", " ".join(fields.values())):
            collect(f"{inner_package}/msg/{inner}")

    collect(name)
    own = seen.pop(name)
    return "\n".join([own, *(f"{'=' * 80}\nMSG: {full.replace('/msg/', '/')}\n{text}" for full, text in seen.items())])
