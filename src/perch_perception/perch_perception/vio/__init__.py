"""Visual-inertial odometry: KLT tracks and an MSCKF with landmarks in the state. Independent of ROS."""

from perch_perception.vio.config import VioConfig
from perch_perception.vio.odometry import VisualInertialOdometry
from perch_perception.vio.result import FrameOutcome, VioPoseEstimate, VioResult

__all__ = ["FrameOutcome", "VioConfig", "VioPoseEstimate", "VioResult", "VisualInertialOdometry"]
