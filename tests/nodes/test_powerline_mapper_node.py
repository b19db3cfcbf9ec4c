"""Node `powerline_mapper` in a lockstep played by the test: a map from rendered wires, a report per image, refusals."""

import numpy as np
import pytest
from nodes.played_vehicle import PlayedVehicle, played
from perch_core import so3
from perch_core.catenary import Catenary
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import to_array
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import PowerlineArray
from perch_perception import powerline_mapper_node
from perch_sim.rendering import CableCurve, Renderer, Scene
from sensor_msgs.msg import Image

MOUNT = load_vehicle("rpg").mounts["front"]
CABLES = [Catenary.from_sag(np.array([3.0, -4.0, z]), np.array([3.2, 4.0, z]), 0.05) for z in (1.9, 2.6)]
PITCH_UP = np.array([0.0, -np.sin(0.05), 0.0, np.cos(0.05)])


@pytest.fixture(scope="module")
def renderer():
    scene = Scene(np.array([-3.0, -4.5, 0.0]), np.array([9.0, 4.5, 6.0]), seed=1, contrast=0.25,
                  cables=tuple(CableCurve(c.sample(60), 0.03, (190.0, 35.0, 35.0)) for c in CABLES))
    return Renderer(scene, MOUNT, seed=1)


class Vehicle(PlayedVehicle):
    """Rises in front of the wires."""

    start, velocity = np.array([0.0, 0.0, 1.8]), np.array([0.0, 0.0, 0.5])
    attitude, sigma, mount = PITCH_UP, 0.005, MOUNT

    def __init__(self, *graph):
        super().__init__(*graph)
        self.maps = []
        self.node.create_subscription(PowerlineArray, "powerlines", self.maps.append, qos.GATED)

    def fly(self, seconds, encoding="rgb8"):
        """Images at 30 Hz, each answered before the next."""
        R_WB = so3.quat_to_matrix(PITCH_UP)
        first = len(self.triggers())
        for k in range(int(30 * seconds)):
            exposed = 0.1 + k / 30
            pixels = self.renderer.render([(self.position(exposed), R_WB)], self.rng)
            msg = Image(height=480, width=640, step=1920, encoding=encoding, data=pixels.tobytes())
            msg.header.stamp = self.stamp(exposed)
            self.images.publish(msg)
            self.advance(exposed + 0.02)
            self.spin_until(lambda: len(self.triggers()) == first + k + 1, f"the report of image {k}")
        return self.maps[-1] if self.maps else None


@pytest.fixture
def graph(ros_domain, renderer):
    with played(powerline_mapper_node, ros_domain, renderer, Vehicle) as start:
        yield start


def test_maps_two_wires_and_reports_every_image(graph):
    vehicle = graph()
    last = vehicle.fly(1.7)
    assert len(set(vehicle.triggers())) == 51, "one report per image"
    assert len(vehicle.maps) == 17, "10 Hz of 30"
    counts = {r.topic: r.count for r in vehicle.reports[-1].published}
    assert counts == {"/powerlines": 17}
    assert last.header.frame_id == "map" and not last.degenerate and last.message == ""
    assert {line.id % 100 for line in last.lines} == {0, 1}
    for line in last.lines:
        start, end = to_array(line.start), to_array(line.end)
        cable = min((c.sample(800) for c in CABLES), key=lambda p: np.linalg.norm(p - start, axis=1).min())
        points = start + np.linspace(0, 1, 9)[:, None] * (end - start)
        assert np.mean([np.linalg.norm(cable - p, axis=1).min() for p in points]) < 0.02
        assert line.radius == pytest.approx(0.03, rel=0.25)
        covariance = np.array(line.covariance).reshape(3, 3)
        assert 0 < np.sqrt(np.linalg.eigvalsh(covariance)[-1]) < 0.15 and 0 < line.direction_sigma < 0.1
        assert line.observations >= 10


def test_says_that_a_motion_along_the_wires_determines_nothing(graph):
    class Sideways(Vehicle):
        velocity = np.array([0.0, 0.5, 0.0])

    last = graph(Sideways).fly(1.0)
    assert last.degenerate and list(last.lines) == [] and "baseline ratio" in last.message


def test_maps_nothing_while_the_odometry_is_unknown(graph):
    class Lost(Vehicle):
        sigma = 100.0

    last = graph(Lost).fly(0.5)
    assert list(last.lines) == [] and "100.00 m only" in last.message


def test_an_image_without_colour_is_refused_but_answered(graph):
    vehicle = graph()
    last = vehicle.fly(0.3, encoding="mono8")
    assert "no colour" in last.message and len(vehicle.triggers()) == 9


@pytest.mark.parametrize(("name", "value", "why"), [
    ("vehicle", "snapdragon", "no colour camera"), ("camera", "down", "front"), ("rate", 0.0, "rate"),
    ("mapper.triangulation.min_ratio", 2.0, "min_ratio")])
def test_refuses_parameters_by_name(graph, name, value, why):
    with pytest.raises(ConfigError, match=why):
        graph(**{name: value})
