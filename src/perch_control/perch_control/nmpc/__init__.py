"""Nonlinear model predictive control. [P:VI]"""

from perch_control.nmpc.controller import NmpcController
from perch_control.nmpc.line_choice import chosen_lines
from perch_control.nmpc.settings import LineWeights, NmpcSettings

__all__ = ["LineWeights", "NmpcController", "NmpcSettings", "chosen_lines"]
