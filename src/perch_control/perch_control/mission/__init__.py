"""Missions: arm, take off, search, plan, fly, verify, recover. `perch_control.mission_component` connects them to channels."""

from perch_control.mission.adhesion import AdhesionMonitor
from perch_control.mission.inspection import InspectionMission
from perch_control.mission.machine import MissionMachine
from perch_control.mission.settings import MissionSettings
from perch_control.mission.surface import SurfaceMission
from perch_control.mission.values import (
    Command, ControllerState, Goal, Inputs, Outcome, Outputs, Phase, Plan, PlanQuery, Refusal, Result, State, Target)
from perch_control.mission.wire import PowerlineMission

__all__ = ["AdhesionMonitor", "Command", "ControllerState", "Goal", "InspectionMission", "Inputs", "MissionMachine",
           "MissionSettings", "Outcome", "Outputs", "Phase", "Plan", "PlanQuery", "PowerlineMission", "Refusal", "Result", "State",
           "SurfaceMission", "Target"]
