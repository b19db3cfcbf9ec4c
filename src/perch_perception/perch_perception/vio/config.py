"""Settings of visual-inertial odometry, with units and ranges (`config/vio.yaml`)."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.config import part, quantity

from perch_perception.ukf.config import ImuFaults, ImuNoise, RestConfig


@dataclass(frozen=True)
class TrackerConfig:
    """KLT tracks."""

    features: int = quantity(100, low=10, high=400, doc="tracks to keep up")
    refill: float = quantity(0.85, low=0.1, high=1.0, doc="detect new features below this share of them")
    spacing: float = quantity(18.0, unit="px", above=2.0, doc="least distance between features")
    crowding: float = quantity(0.6, unit="-", low=0.0, high=1.0,
                               doc="features nearer to an older one than this share of the spacing are let go; 0: none")
    flatten: float = quantity(20.0, unit="px", low=0.0, high=200.0,
                              doc="sigma over which brightness is averaged and taken off (vignetting, shadows); 0: not at all")
    quality: float = quantity(0.01, above=0.0, high=1.0, doc="least corner strength, share of the strongest")
    noise_factor: float = quantity(8.0, low=0.0, high=100.0, doc="least corner strength, in those that noise alone makes")
    window: int = quantity(21, unit="px", low=5, high=61, doc="side of the tracked patch")
    levels: int = quantity(3, low=0, high=6, doc="pyramid levels above the image")
    reference_change: float = quantity(8.0, unit="px", low=0.0, doc="motion apart that asks for a new reference; 0: each frame")


@dataclass(frozen=True)
class FilterConfig:
    """The MSCKF."""

    clones: int = quantity(11, low=4, high=30, doc="poses in the sliding window")
    landmarks: int = quantity(25, low=0, high=100, doc="points kept in the state")
    pixel_noise: float = quantity(0.085, unit="px", above=0.0, doc="1 sigma of a track, white from frame to frame")
    slide_turn: float = quantity(0.9, unit="px/sqrt(rad)", low=0.0, doc="walk of a tracked point, by the angle that its bearing moves")
    slide_zoom: float = quantity(2.0, unit="px", low=0.0, doc="walk of a tracked point, by the root of its distance's change of logarithm")
    gate_probability: float = quantity(0.99, above=0.5, high=0.999999, doc="chi2 gate of a track or landmark")


@dataclass(frozen=True)
class CalibrationPriors:
    """1 sigma of what a careful calibration leaves open; zero fixes a quantity."""

    rotation: float = quantity(0.0087, unit="rad", low=0.0, high=0.2, doc="camera against IMU, all axes together")
    translation: float = quantity(0.002, unit="m", low=0.0, high=0.1)
    time_offset: float = quantity(0.002, unit="s", low=0.0, high=0.05)
    focal: float = quantity(0.003, unit="-", low=0.0, high=0.05, doc="relative error of each focal length")
    centre: float = quantity(0.5, unit="px", low=0.0, high=50.0, doc="principal point, per axis")


@dataclass(frozen=True)
class StartConfig:
    """How the filter starts, and how well the pose is known that it is told."""

    position_sigma: float = quantity(0.001, unit="m", above=0.0)
    yaw_sigma: float = quantity(0.001, unit="rad", above=0.0)
    motion_time: float = quantity(0.5, unit="s", above=0.2, high=3.0, doc="frames needed for a start in motion")
    ground_sigma: float = quantity(0.005, unit="m", above=0.0, doc="1 sigma of the ground about its plane")
    ground_least_height: float = quantity(0.08, unit="m", above=0.0, doc="a camera standing lower sees no landmarks on the ground")


@dataclass(frozen=True)
class LossConfig:
    """When odometry counts as blind, as lost, and when it starts again."""

    restart_velocity: float = quantity(1.0, unit="m/s", above=0.0, doc="1 sigma that ends a run")
    speed: float = quantity(25.0, unit="m/s", above=0.0, doc="faster flies no vehicle that this is for: the filter has diverged")
    frames: int = quantity(15, low=2, doc="frames over which observations that are refused and used are counted")
    refused: int = quantity(20, low=1, doc="a run ends where more are refused than used, and than this")


@dataclass(frozen=True)
class VioConfig:
    """Visual-inertial odometry."""

    imu: ImuNoise = part(ImuNoise)
    faults: ImuFaults = part(ImuFaults)
    rest: RestConfig = part(RestConfig)
    tracker: TrackerConfig = part(TrackerConfig)
    filter: FilterConfig = part(FilterConfig)
    calibration: CalibrationPriors = part(CalibrationPriors)
    start: StartConfig = part(StartConfig)
    loss: LossConfig = part(LossConfig)
