"""Typed errors of the whole suite: each names the wrong value, its source and what is allowed."""

from __future__ import annotations

from typing import Any


class PerchError(ValueError):
    """Base of every error that a caller can cause and correct. It can be pickled whatever arguments its constructor has."""

    def __reduce__(self) -> tuple[Any, ...]:
        return _unpickled, (type(self), self.args, vars(self))


def _unpickled(cls: type[PerchError], args: tuple[Any, ...], attributes: dict[str, Any]) -> PerchError:
    error = cls.__new__(cls, *args)
    error.args = args
    error.__dict__.update(attributes)
    return error


class ConfigError(PerchError):
    """A value in a YAML file, a parameter or a command line is not usable.

    The message reads `<source>: <key>: <value> <why it is refused>`, on one line; long parts are shortened.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source, self.key, self.problem = (_line(part) for part in (source, key, problem))
        super().__init__(": ".join(part for part in (self.source, self.key, self.problem) if part))


def _line(text: str) -> str:
    """Return text on one line, without control characters; the middle of a long text is left out."""
    line = "".join(c if c.isprintable() else "?" for c in " ".join(str(text).split()))
    return line if len(line) <= 1000 else f"{line[:600]} ... {line[-300:]}"


class FreeFallError(PerchError):
    """Raised when the specific thrust vanishes, so that flatness defines no attitude. [M:eq10]"""


class PlanningRefusal(PerchError):
    """Raised when a planner finds no plan within the limits.

    Attributes:
        code: machine-readable cause: the lower-case name of the service's error code (`thrust_floor`).
        constraint: the violated constraint, in words with its equation.
        margin: distance from the constraint's limit, in the constraint's own unit; negative: violated.
    """

    def __init__(self, code: str, constraint: str, margin: float, message: str) -> None:
        self.code, self.constraint, self.margin = code, constraint, float(margin)
        super().__init__(message)
