"""Typed errors of the whole suite: each says what was wrong, where it came from and what is allowed."""

from __future__ import annotations


class PerchError(ValueError):
    """Base of every error that a caller can cause and mend."""


class ConfigError(PerchError):
    """A value in a YAML file, a parameter or a command line is not usable.

    The message reads `<source>: <key>: <value> <why it is refused>`.
    """

    def __init__(self, source: str, key: str, problem: str) -> None:
        self.source, self.key, self.problem = source, key, problem
        super().__init__(": ".join(part for part in (source, key, problem) if part))


class FreeFallError(PerchError):
    """The specific thrust vanishes, so that flatness defines no attitude. [M:eq10]"""


class PlanningRefusal(PerchError):
    """A planner answers that there is no plan within the limits.

    Attributes:
        code: machine-readable cause, the lower-case name of the service's error code (`thrust_floor`).
        constraint: the violated constraint, in words with its equation.
        margin: by how much it is violated, in the constraint's own unit (negative: violated).
    """

    def __init__(self, code: str, constraint: str, margin: float, message: str) -> None:
        self.code, self.constraint, self.margin = code, constraint, float(margin)
        super().__init__(message)
