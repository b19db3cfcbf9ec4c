"""State estimator: an unscented Kalman filter on SO(3) that fuses IMU samples and delayed VIO poses. Independent of ROS."""

from perch_core.values import ImuSample
from perch_perception.ukf.config import ImuNoise, UkfConfig, VioNoise
from perch_perception.ukf.estimator import Estimator
from perch_perception.ukf.imu_buffer import ImuOutcome
from perch_perception.ukf.measurement import Estimate, Health, Inertial, Status, VioOutcome, VioPose

__all__ = ["Estimate", "Estimator", "Health", "ImuNoise", "ImuOutcome", "ImuSample", "Inertial",
           "Status", "UkfConfig", "VioNoise", "VioOutcome", "VioPose"]
