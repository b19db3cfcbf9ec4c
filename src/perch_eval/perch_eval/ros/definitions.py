"""Message types by name, and their definitions as MCAP and Foxglove want them."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from ament_index_python.packages import get_package_share_directory

from perch_eval.mcap_log import Schema

_PRIMITIVE = {"bool", "byte", "char", "float32", "float64", "int8", "uint8", "int16", "uint16", "int32", "uint32",
              "int64", "uint64", "string", "wstring"}


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
    """Definition of a type followed by those of everything it contains, in MCAP's `ros2msg` form."""
    seen: dict[str, str] = {}

    def collect(full: str) -> None:
        package, kind, short = full.split("/")
        if full in seen:
            return
        seen[full] = (Path(get_package_share_directory(package)) / kind / f"{short}.msg").read_text()
        for line in seen[full].splitlines():
            word = line.split("#")[0].strip().split(" ")[0]
            base = word.split("[")[0].split("<")[0]
            if not base or base in _PRIMITIVE:
                continue
            inner_package, _, inner = base.rpartition("/")
            collect(f"{inner_package.split('/')[0] or package}/msg/{inner}")

    collect(name)
    first, *rest = seen
    parts = [seen[first]]
    for full in rest:
        package, _, short = full.split("/")
        parts += ["=" * 80, f"MSG: {package}/{short}", seen[full]]
    return "\n".join(parts)
