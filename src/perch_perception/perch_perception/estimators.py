"""Registry of the state estimators: name -> class. A custom one is added by one line; see docs/howto/own_estimator.md."""

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
    """Parameters of the node `estimator`; another estimator derives its own class from this one."""

    type: str = text("ukf", doc="estimator, one of perch_perception.estimators")


def estimator_class(name: Any) -> type[Component[Any]]:
    """Return the component class of an estimator.

    Raises:
        ConfigError: there is no estimator with this name.
    """
    if not isinstance(name, str) or name not in ESTIMATORS:
        raise ConfigError("estimator", "type", f"{name!r} is not one of {', '.join(ESTIMATORS)}")
    return resolved(ESTIMATORS[name])
