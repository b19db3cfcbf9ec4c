"""Registry of the control laws: name -> class. Another law takes one more line; see docs/howto/own_controller.md."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perch_core.errors import ConfigError
from perch_core.registry import resolved

if TYPE_CHECKING:
    from perch_control.law import Law

LAWS: dict[str, str] = {
    "geometric": "perch_control.geometric:GeometricController",
    "nmpc": "perch_control.nmpc:NmpcController",
}


def check_law(name: str) -> None:
    """Check the name of a law.

    Raises:
        ConfigError: there is no law with this name.
    """
    if name not in LAWS:
        raise ConfigError("", "type", f"{name!r} is not one of {', '.join(LAWS)}")


def law_class(name: str) -> type[Law]:
    """Return the class of a law.

    Raises:
        ConfigError: there is no law with this name.
    """
    check_law(name)
    return resolved(LAWS[name])
