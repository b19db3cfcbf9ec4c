"""Names in a registry to the classes behind them."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from perch_core.errors import ConfigError


def resolved(place: str) -> Any:
    """What stands at `module:name`; the module is imported when it is asked for.

    Raises:
        ConfigError: there is no such module, or nothing of that name in it.
    """
    module, _, name = place.partition(":")
    try:
        return getattr(import_module(module), name)
    except ModuleNotFoundError as error:
        if error.name is None or not f"{module}.".startswith(f"{error.name}."):
            raise  # the module is there; something that it needs is not
        raise ConfigError("", place, f"there is no module {error.name!r}") from None
    except AttributeError:
        raise ConfigError("", place, f"there is no {name!r} in {module}") from None
