"""Perches on powerlines by nonlinear programming: plan, check, recover. [P:V]

`PowerlinePlanner` plans; `service` converts requests and plans from and to the values of the service; `problem` reads files;
`report` writes results.
"""

from perch_planner.powerline.plan import Manoeuvre, PowerlinePlan
from perch_planner.powerline.planner import PowerlinePlanner
from perch_planner.powerline.request import PerchPose, PowerlineRequest
from perch_planner.powerline.settings import PowerlineSettings

__all__ = ["Manoeuvre", "PerchPose", "PowerlinePlan", "PowerlinePlanner", "PowerlineRequest", "PowerlineSettings"]
