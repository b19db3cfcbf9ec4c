"""The state estimators that can be flown: name -> class. One of your own is one more line; see docs/howto/own_estimator.md."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from perch_core.component import Component
from perch_core.config import text
from perch_core.errors import ConfigError
from perch_core.registry import resolved
from perch_perception.ukf import UkfConfig

ESTIMATORS: dict[str, str] = {
    "ukf": "perch_perception.estimator_component:StateEstimator",
}


@dataclass(frozen=True)
class EstimatorConfig(UkfConfig):
    """Parameters of the node `estimator`; those of another estimator are a class derived from this one."""

    type: str = text("ukf", doc="estimator, one of perch_perception.estimators")


def estimator_class(name: Any) -> type[Component[Any]]:
    """The component of an estimator.

    Raises:
        ConfigError: there is none with this name.
    """
    if not isinstance(name, str) or name not in ESTIMATORS:
        raise ConfigError("estimator", "type", f"{name!r} is not one of {', '.join(ESTIMATORS)}")
    return resolved(ESTIMATORS[name])
