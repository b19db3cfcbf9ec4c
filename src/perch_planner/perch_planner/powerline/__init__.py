"""Perches on powerlines by nonlinear programming: plan, check, recover. [P:V]

`PowerlinePlanner` plans in this process, `PowerlineWorker` in one that can be killed; `problem` reads files, `report` writes what came out.
"""

from perch_planner.powerline.certificate import Bound
from perch_planner.powerline.plan import Manoeuvre, PowerlinePlan
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings
from perch_planner.powerline.worker import PowerlineWorker

__all__ = ["Bound", "Manoeuvre", "PerchPose", "PowerlinePlan", "PowerlinePlanner", "PowerlineRequest", "PowerlineSettings",
           "PowerlineWorker"]
