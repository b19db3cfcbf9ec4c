"""Perches on powerlines by nonlinear programming: plan, check, recover. [P:V]

`PowerlinePlanner` plans, `service` turns requests and plans into values of its service and back; `problem` reads files, `report` writes
what came out.
"""

from perch_planner.powerline.plan import Manoeuvre, PowerlinePlan
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

__all__ = ["Manoeuvre", "PerchPose", "PowerlinePlan", "PowerlinePlanner", "PowerlineRequest", "PowerlineSettings"]
