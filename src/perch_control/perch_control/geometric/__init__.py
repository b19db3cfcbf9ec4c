"""Geometric tracking control on SE(3). [M:eq2, M:eq12, M:eq13]"""

from perch_control.geometric.controller import GeometricController, packed_vehicle
from perch_control.law import ControlOutput

__all__ = ["ControlOutput", "GeometricController", "packed_vehicle"]
