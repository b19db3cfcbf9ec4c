"""Camera images of a textured scene: numpy and OpenCV, 5-10 ms per VGA fisheye frame."""

from perch_sim.rendering.renderer import Pose, Renderer
from perch_sim.rendering.scenario_scene import build_scene
from perch_sim.rendering.scene import CableCurve, Scene
from perch_sim.rendering.sensor import Exposure, control_exposure

__all__ = ["CableCurve", "Exposure", "Pose", "Renderer", "Scene", "build_scene", "control_exposure"]
