"""Camera images of a textured scene: numpy and OpenCV, 5-10 ms per VGA fisheye frame."""

from perch_sim.rendering.renderer import Renderer
from perch_sim.rendering.scenario_scene import build_scene
from perch_sim.rendering.scene import Box, CableCurve, Scene

__all__ = ["Box", "CableCurve", "Renderer", "Scene", "build_scene"]
