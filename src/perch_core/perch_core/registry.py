"""Resolution of references `module:name` to Python objects."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from perch_core.errors import ConfigError


def resolved(place: str) -> Any:
    """Return the object at `module:name`; its module is imported by this call.

    Raises:
        ConfigError: the module does not exist, or has no object of that name.
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
