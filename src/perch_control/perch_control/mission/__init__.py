"""The mission: arm, take off, look, plan, fly, verify, recover. Free of ROS; `mission_node` wraps it."""

from perch_control.mission.adhesion import AdhesionMonitor, AdhesionLimits
from perch_control.mission.machine import MissionMachine
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import (
    Command, ControllerState, Goal, Inputs, Mode, Outcome, Outputs, Phase, PlanAnswer, PlanQuery, Result, State, Target)

__all__ = ["AdhesionLimits", "AdhesionMonitor", "Command", "ControllerState", "Goal", "Inputs", "MissionMachine",
           "MissionSettings", "Mode", "Outcome", "Outputs", "Phase", "PlanAnswer", "PlanQuery", "Result", "State", "Target"]
