"""Messages that are wrong in one respect each, made from good ones."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable, Iterator
from typing import Any

from geometry_msgs.msg import Quaternion

HUGE = 1100  # elements
FAR = 2**31 - 1  # [s]


def kinds(message: Any) -> Iterator[tuple[str, Any]]:
    """(what is wrong, message) for each way in which a good message can be spoiled."""
    for name, spoil in _ways(message):
        spoilt = copy.deepcopy(message)
        spoil(spoilt)
        yield name, spoilt


def _ways(message: Any) -> Iterator[tuple[str, Callable[[Any], None]]]:
    for path, kind, value in _leaves(message, ()):
        name, set_to = ".".join(map(str, path)), _setter(path)
        if isinstance(value, Quaternion):
            yield f"{name} is zero", lambda m, p=path: _clear(_at(m, p))
        elif kind == "frame":
            yield f"{name} is elsewhere", lambda m, s=set_to: s(m, "elsewhere")
        elif kind == "stamp":
            for word, sec in (("past", 1), ("negative", -5), ("future", FAR)):
                yield f"{name} is {word}", lambda m, p=path, sec=sec: setattr(_at(m, p), "sec", sec)
        elif kind == "float":
            for bad in (math.nan, math.inf, 1e300):
                yield f"{name} is {bad:g}", lambda m, s=set_to, bad=bad: s(m, bad)
        elif kind == "text":
            yield f"{name} is nonsense", lambda m, s=set_to: s(m, "\u00e9" * HUGE)
        elif kind == "whole":
            yield f"{name} is its largest", lambda m, s=set_to, v=value: s(m, v)
        elif kind == "sequence":
            yield f"{name} is empty", lambda m, s=set_to, v=value: s(m, v[:0])
            yield f"{name} is huge", lambda m, s=set_to, v=value: s(m, (v[:1] or v) * HUGE)


def _leaves(message: Any, path: tuple) -> Iterator[tuple[tuple, str, Any]]:
    """Path, kind and value of what can be spoiled; of arrays and sequences the first element, too."""
    for field, kind in message.get_fields_and_field_types().items():
        value, here = getattr(message, field), (*path, field)
        if field == "stamp":
            yield here, "stamp", value
        elif field == "frame_id":
            yield here, "frame", value
        elif isinstance(value, Quaternion):
            yield here, "", value
            yield from _leaves(value, here)
        elif hasattr(value, "get_fields_and_field_types"):
            yield from _leaves(value, here)
        elif kind in ("double", "float"):
            yield here, "float", value
        elif kind == "string":
            yield here, "text", value
        elif kind.startswith(("uint", "int")) and "[" not in kind:
            bits, signed = int(kind.lstrip("uint")), kind.startswith("int")
            yield here, "whole", 2 ** (bits - signed) - 1
        elif kind.startswith("sequence"):
            yield here, "sequence", value
            if len(value) and hasattr(value[0], "get_fields_and_field_types"):
                yield from _leaves(value[0], (*here, 0))
            elif len(value) and "double" in kind:
                yield (*here, 0), "float", value[0]
        elif "double[" in kind:
            yield (*here, 0), "float", value[0]


def _at(message: Any, path: tuple) -> Any:
    for part in path:
        message = message[part] if isinstance(part, int) else getattr(message, part)
    return message


def _setter(path: tuple) -> Callable[[Any, Any], None]:
    def put(message: Any, value: Any) -> None:
        owner = _at(message, path[:-1])
        if isinstance(path[-1], int):
            owner[path[-1]] = value
        else:
            setattr(owner, path[-1], value)

    return put


def _clear(q: Quaternion) -> None:
    q.x = q.y = q.z = q.w = 0.0
