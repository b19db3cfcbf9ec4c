"""Powerlines from images: wires are detected, associated and triangulated with the poses of their exposures."""

from perch_perception.line_mapping.backdrop import BackgroundCheck
from perch_perception.line_mapping.curve import WireCurve
from perch_perception.line_mapping.detection import LineDetectionConfig, LineSighting, detect_lines
from perch_perception.line_mapping.mapper import LineMapper, MapperConfig
from perch_perception.line_mapping.observation import LineObservation, place
from perch_perception.line_mapping.triangulation import (
    TriangulationConfig, Undetermined, WireEstimate, triangulate)

__all__ = ["BackgroundCheck", "Undetermined", "LineDetectionConfig", "LineMapper", "LineObservation", "LineSighting", "MapperConfig",
           "TriangulationConfig", "WireCurve", "WireEstimate", "detect_lines", "place", "triangulate"]
