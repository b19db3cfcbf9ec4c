"""Settings of visual-inertial odometry, with units and ranges (`config/vio.yaml`)."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import derived, part, quantity
from perch_core.sensors import CalibrationSigmas

from perch_perception.ukf.config import ImuNoise


@dataclass(frozen=True)
class TrackerConfig:
    """Settings of the KLT tracker."""

    features: int = quantity(100, low=10, high=400, doc="tracks to keep up")


@dataclass(frozen=True)
class FilterConfig:
    """Settings of the MSCKF."""

    clones: int = quantity(11, low=4, high=30, doc="poses in the sliding window")
    landmarks: int = quantity(25, low=0, high=100, doc="points kept in the state")
    slide_turn: float = quantity(0.9, unit="px/sqrt(rad)", low=0.0, doc="walk of a tracked point, by the root of the angle that its bearing moves")
    slide_zoom: float = quantity(0.7, unit="px", low=0.0, doc="walk of a tracked point, by the root of its distance's change of logarithm")


@dataclass(frozen=True)
class VioConfig:
    """Settings of visual-inertial odometry."""

    imu: ImuNoise = derived(ImuNoise())
    calibration: CalibrationSigmas = derived(CalibrationSigmas())
    tracker: TrackerConfig = part(TrackerConfig)
    filter: FilterConfig = part(FilterConfig)
