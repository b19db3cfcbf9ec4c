"""Values that cross ports, each with frames, units and shapes. They are immutable, so a receiver may keep them."""

from perch_core.values.flight import (
    AtEnd, AttitudeThrust, Command, ControllerCommand, ControllerStatus, ControlReference, MotorCommand, RatesThrust,
    SetControllerRequest, SetControllerResponse, TrajectoryOrder, TriggerRequest, TriggerResponse)
from perch_core.values.markers import Marker, Markers, Shape
from perch_core.values.mission import PerchFeedback, PerchGoal, PerchResult
from perch_core.values.perching import MappedPowerline, PowerlineMap, TargetPose, TargetSighting
from perch_core.values.planning import Certificate, PerchPlan, PerchPlanRequest, PowerlinePlan, PowerlinePlanRequest
from perch_core.values.sensing import CameraImage, CameraModel, CompressedPixels, ImuSample, Serialized, StampedTransform, Transform
from perch_core.values.stamps import NANOSECONDS, STALE, nanoseconds, seconds
from perch_core.values.state import Contact, EstimatorHealth, InertialState, OdometryState, PoseStamped, RotorState, rotated

__all__ = [
    "NANOSECONDS", "STALE", "AtEnd", "AttitudeThrust", "CameraImage", "CameraModel", "Certificate", "Command", "CompressedPixels", "Contact",
    "ControlReference", "ControllerCommand", "ControllerStatus", "EstimatorHealth", "ImuSample", "InertialState",
    "MappedPowerline", "Marker", "Markers", "MotorCommand", "OdometryState", "PerchFeedback", "PerchGoal", "PerchPlan",
    "PerchPlanRequest", "PerchResult", "PoseStamped", "PowerlineMap", "PowerlinePlan", "PowerlinePlanRequest", "RatesThrust",
    "RotorState", "Serialized", "SetControllerRequest", "SetControllerResponse", "Shape", "StampedTransform", "TargetPose",
    "TargetSighting", "TrajectoryOrder", "Transform", "TriggerRequest", "TriggerResponse", "nanoseconds", "rotated", "seconds",
]
