"""Messages that are wrong in some respects, made from good ones: what of a message can be spoiled, how, and which of it makes no sense at all."""

from __future__ import annotations

import array
import copy
import math
import random
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np

Path = tuple[str | int, ...]
HUGE = 1100       # entries
ENORMOUS = 30_000
FAR = 2**31 - 1   # [s]
SECOND = 10**9

FLOATS = (math.nan, math.inf, -math.inf, 1e308, -1e308, 5e-324, 0.0, -0.0, 1.0, -1.0, 1e3, 1e9, -1e-9, math.pi)
SENSELESS_FLOATS = (math.nan, math.inf, -math.inf, 1e308, -1e308)
FRAMES = ("", "map", "odom", "base_link", "imu_link", "elsewhere", "camera_down_optical_frame", "e" * 10_000)
TEXTS = ("", "nmpc", "geometric", "8UC1", "mono16", "plumb_bob", "\u00e9" * HUGE, "\x07\n\x1b[2J", "x" * 100_000)
STAMPS = {"past": SECOND, "negative": -5 * SECOND, "future": FAR * SECOND, "zero": 0}
SHIFTS = (1, -1, 2_000_000, -2_000_000, 40_000_000, -40_000_000, 500_000_000, -500_000_000, 3 * SECOND, -3 * SECOND, 60 * SECOND, 10**6 * SECOND)
MATRICES = ("zero", "negative", "nan", "enormous", "uneven", "indefinite", "tiny")
TURNS = ("zero", "longer", "double", "opposite", "nan")


class Way(NamedTuple):
    """One thing that is done to a message, as JSON can carry it: where, what, with which value."""

    path: Path
    kind: str
    value: Any

    def __str__(self) -> str:
        return f"{'.'.join(map(str, self.path))} {self.kind} {str(self.value)[:40]}"


def leaves(message: Any, path: Path = ()) -> Iterator[tuple[Path, str, Any]]:
    """Path, kind and value of what can be spoiled; of arrays and sequences the first entry, too."""
    for field, kind in message.get_fields_and_field_types().items():
        value, here = getattr(message, field), (*path, field)
        if field.endswith("stamp") or kind == "builtin_interfaces/Time":
            yield here, "stamp", value
        elif field.endswith("frame_id"):
            yield here, "frame", value
        elif kind == "geometry_msgs/Quaternion":
            yield here, "turn", value
            yield from leaves(value, here)
        elif hasattr(value, "get_fields_and_field_types"):
            yield from leaves(value, here)
        elif kind in ("double", "float"):
            yield here, "float", value
        elif kind == "string":
            yield here, "text", value
        elif kind == "boolean":
            yield here, "flag", value
        elif kind.startswith(("uint", "int")) and "[" not in kind:
            bits, signed = int(kind.lstrip("uint")), kind.startswith("int")
            yield here, "whole", 2 ** (bits - signed) - 1
        elif kind.startswith("sequence"):
            yield here, "bytes" if "uint8" in kind else "sequence", value
            if len(value) and hasattr(value[0], "get_fields_and_field_types"):
                yield from leaves(value[0], (*here, 0))
            elif len(value) and "double" in kind:
                yield (*here, 0), "float", value[0]
        elif "double[" in kind:
            if len(value) in (9, 36, 225) and "covariance" in field:
                yield here, "matrix", value
            yield (*here, 0), "float", value[0]


def some_way(message: Any, rng: random.Random) -> Way:
    """Something to do to a message."""
    path, kind, value = rng.choice(list(leaves(message)))
    if kind == "float":
        how = rng.random()
        return Way(path, "=", rng.choice(FLOATS)) if how < 0.6 else Way(path, "*", 10.0 ** rng.randint(-12, 12)) if how < 0.8 else \
            Way(path, "+", rng.gauss(0.0, 1.0))
    if kind == "stamp":
        return Way(path, "stamp", rng.choice(tuple(STAMPS))) if rng.random() < 0.5 else Way(path, "shift", rng.choice(SHIFTS))
    if kind == "whole":
        return Way(path, "=", rng.choice((0, 1, 2, 3, 4, 7, 9, 100, value // 2, value - 1, value)))
    if kind == "flag":
        return Way(path, "=", not value)
    if kind == "sequence":
        return Way(path, "count", rng.choice((0, 0, 1, 2, len(value) + 1, max(len(value) - 1, 0), 60, 120, HUGE, ENORMOUS)))
    if kind == "bytes":
        return Way(path, "bytes", rng.choice(("empty", "half", "noise", "dark", "bright")))
    choices = {"frame": ("=", FRAMES), "text": ("=", TEXTS), "turn": ("turn", TURNS), "matrix": ("matrix", MATRICES)}
    how, values = choices[kind]
    return Way(path, how, rng.choice(values))


def spoilt(message: Any, ways: list[Way]) -> Any:
    """A copy of a message with all that done to it; what a change before it has taken away stays away."""
    message = copy.deepcopy(message)
    for path, kind, value in ways:
        try:
            owner = _at(message, path[:-1])
            old = owner[path[-1]] if isinstance(path[-1], int) else getattr(owner, path[-1])
        except (IndexError, AttributeError):
            continue
        new = _changed(old, kind, value)
        if isinstance(path[-1], int):
            owner[path[-1]] = new
        else:
            setattr(owner, path[-1], new)
    return message


def _changed(old: Any, kind: str, value: Any) -> Any:
    if kind == "=":
        return value
    if kind == "*":
        return float(old) * value
    if kind == "+":
        return float(old) + value
    if kind in ("stamp", "shift"):
        stamp = STAMPS[value] if kind == "stamp" else old.sec * SECOND + old.nanosec + value
        old.sec, old.nanosec = min(max(stamp // SECOND, -(2**31)), FAR), stamp % SECOND
        return old
    if kind == "turn":
        factor = {"zero": 0.0, "longer": 1.02, "double": 2.0, "opposite": -1.0, "nan": math.nan}[value]
        old.x, old.y, old.z, old.w = (factor * x for x in (old.x, old.y, old.z, old.w))
        return old
    if kind == "matrix":
        return _matrix(np.array(old, float), value).ravel()
    if kind == "count":
        entries = list(old)
        return (entries * (value // max(len(entries), 1) + 1))[:value] if entries else entries
    content = {"empty": b"", "half": bytes(old[: len(old) // 2]), "noise": random.Random(len(old)).randbytes(len(old)), "dark": bytes(len(old)),
               "bright": b"\xff" * len(old)}[value]
    return array.array("B", content)


def _matrix(flat: np.ndarray, how: str) -> np.ndarray:
    n = math.isqrt(len(flat))
    with np.errstate(all="ignore"):
        return _spoilt_matrix(flat.reshape(n, n).copy(), n, how)


def _spoilt_matrix(C: np.ndarray, n: int, how: str) -> np.ndarray:
    if how == "uneven":
        C[0, 1] += 1.0 + abs(C[0, 1])
    elif how == "indefinite":
        C[0, 1] = C[1, 0] = 10.0 * (abs(C[0, 0]) + abs(C[1, 1]) + 1e-3)
    elif how == "nan":
        C[n - 1, 0] = math.nan
    else:
        C *= {"zero": 0.0, "negative": -1.0, "enormous": 1e300, "tiny": 1e-200}[how]
        if how in ("negative", "enormous"):
            C += {"negative": -1.0, "enormous": 1e300}[how] * np.eye(n)
    return C


def senseless(way: Way) -> bool:
    """Whether a field that means something makes no sense any more, whatever its message and the moment."""
    if way.kind == "=":
        return way.value == "elsewhere" or any(way.value is x or way.value == x for x in SENSELESS_FLOATS) or way.value != way.value
    if way.kind == "stamp":
        return way.value == "future"
    if way.kind == "turn":
        return way.value in ("zero", "longer", "double", "nan")
    if way.kind == "matrix":
        return way.value in ("negative", "nan", "enormous")
    return way.kind == "count" and way.value == ENORMOUS or way.kind == "bytes" and way.value == "empty"


def in_effect(way: Way, original: Any, message: Any) -> bool:
    """Whether what was done to a field is still there: nothing can be repeated in an empty sequence, and a later change counts."""
    alone = spoilt(original, [way])
    try:
        before, after, now = (repr(_at(m, way.path)) for m in (original, alone, message))
    except (IndexError, AttributeError):
        return False
    return before != after == now


def plain_ways(message: Any) -> dict[str, Way]:
    """What is wrong -> way, for each of the plainest ways in which a good message can be spoiled."""
    return {f"{'.'.join(map(str, path))} is {word}": Way(path, how, new)
            for path, kind, value in leaves(message) for word, how, new in _plain(kind, value)}


def kinds(message: Any) -> Iterator[tuple[str, Any]]:
    """(what is wrong, message) for each of the plainest ways."""
    return ((wrong, spoilt(message, [way])) for wrong, way in plain_ways(message).items())


def _plain(kind: str, value: Any) -> Iterator[tuple[str, str, Any]]:
    if kind == "turn":
        yield "zero", "turn", "zero"
    elif kind == "frame":
        yield "elsewhere", "=", "elsewhere"
    elif kind == "stamp":
        yield from ((word, "stamp", word) for word in ("past", "negative", "future"))
    elif kind == "float":
        yield from ((f"{bad:g}", "=", bad) for bad in (math.nan, math.inf, 1e300))
    elif kind == "text":
        yield "nonsense", "=", "\u00e9" * HUGE
    elif kind == "whole":
        yield "its largest", "=", value
    elif kind == "sequence":
        yield "empty", "count", 0
        yield "huge", "count", HUGE
    elif kind == "bytes":
        yield "empty", "bytes", "empty"
        yield "cut short", "bytes", "half"


def _at(message: Any, path: Path) -> Any:
    for part in path:
        message = message[part] if isinstance(part, int) else getattr(message, part)
    return message
