"""Localisation of the perching target in camera images: tag detection, corner measurement, board pose and fusion."""

from perch_perception.tags.average import average_board
from perch_perception.tags.detector import Detection, TagDetector
from perch_perception.tags.fusion import FusedTarget, fuse, start_fusion
from perch_perception.tags.localizer import BoardLocalizer, Localization
from perch_perception.tags.map_pose import MapPose, to_map
from perch_perception.tags.pose import BoardPose, LocalizationRefusal, solve_board
from perch_perception.tags.refinement import RefinedCorners, refine_corners

__all__ = [
    "BoardLocalizer", "BoardPose", "Detection", "FusedTarget", "Localization", "LocalizationRefusal",
    "MapPose", "RefinedCorners", "TagDetector", "average_board", "fuse", "refine_corners", "solve_board",
    "start_fusion", "to_map",
]
