"""Geometric tracking control on SE(3). [M:eq2, M:eq12, M:eq13]"""

from perch_control.geometric.controller import GeometricController, packed_vehicle

__all__ = ["GeometricController", "packed_vehicle"]
