"""Node `vehicle` and the processes that draw its images: their start, images that come late, and a process that ends."""

from __future__ import annotations

import os
import signal

import numpy as np
import rclpy
from nodes.vehicle_flight import seen_steps, stamps
from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds
from perch_core.ros.lockstep import Participant
from perch_core.scenario import load_scenario
from perch_core.timing import TICK_STEPS
from perch_core.vehicle import load_vehicle
from perch_sim import vehicle_node
from sensor_msgs.msg import Image


def test_images_carry_pictures_with_the_stamps_of_their_camera_info(flights):
    flight = flights(cameras="front")
    seen = flight.fly(120)
    images = seen["camera_front/image_raw"]
    for _ in range(20_000):  # the flight may be two images ahead of those who draw
        if len(images) >= 6:
            break
        flight.executor.spin_once(timeout_sec=0.02)
    assert 6 <= len(images) <= 30.0 * 0.002 * len(seen["step"])
    pixels = np.frombuffer(images[0].data, np.uint8).reshape(images[0].height, images[0].width)
    assert (images[0].encoding, pixels.shape) == ("mono8", (480, 640)) and pixels.std() > 5.0
    known = set(stamps(seen["camera_front/camera_info"]))
    assert set(stamps(images)) <= known


def test_the_first_step_waits_for_the_processes_that_draw(flights, monkeypatch):
    """They take a second to start; a flight that begins before would stand still at its first image."""
    drawn = []
    monkeypatch.setattr(vehicle_node.DrawnInProcesses, "ready", lambda self: bool(drawn))
    flight = flights()
    for _ in range(100):
        flight.executor.spin_once(timeout_sec=0.01)
    assert not seen_steps(flight)
    drawn.append(True)
    flight.fly(20)


def with_localizer(flights):
    """A flight with front images and someone who reports each of them."""
    flight = flights(cameras="front", participants=["controller", "target_localizer"])
    node = rclpy.create_node("target_localizer", context=flight.context)
    flight.nodes.append(node)
    side = Participant(node, every=TICK_STEPS)
    node.create_subscription(Image, "camera_front/image_raw", lambda msg: side.report(msg.header.stamp), qos.IMAGE)
    flight.executor.add_node(node)
    side.greet()
    return flight


def test_an_image_may_be_drawn_until_its_result_is_due(flights, monkeypatch):
    """The flight goes on past the image's arrival, and stands still where the result would count."""
    draw, finished = vehicle_node.DrawnInProcesses.draw, []

    class Slow:
        def __init__(self, image):
            self.image = image

        def done(self, timeout=0.0):
            return bool(finished) and self.image.done(timeout)

        def result(self):
            return self.image.result()

    monkeypatch.setattr(vehicle_node.DrawnInProcesses, "draw", lambda self, *order: Slow(draw(self, *order)))
    flight = with_localizer(flights)
    flight.fly(20)
    stands = -1
    while stands != len(seen_steps(flight)):  # one call handles one message
        stands = len(seen_steps(flight))
        for _ in range(300):
            flight.executor.spin_once(timeout_sec=0.002)
    assert not flight.seen["camera_front/image_raw"]
    finished.append(True)
    flight.fly(100)
    frame = stamps(flight.seen["camera_front/image_raw"])[0]
    exposed = frame - load_vehicle("snapdragon").mounts["front"].stamp_offset * 1e9
    due = exposed + load_scenario("surface_90").latency.target_localizer * 1e9
    assert abs(nanoseconds(seen_steps(flight)[stands].stamp) - due) < 8e6  # the board's offset is known to 4 ms


def test_a_flight_goes_on_without_the_images_of_a_process_that_has_ended(flights, capfd):
    flight = with_localizer(flights)
    flight.fly(80)
    os.kill(flight.vehicle._drawing.process_ids["front"], signal.SIGKILL)
    seen = flight.fly(300)
    assert len(seen["camera_front/camera_info"]) > len(seen["camera_front/image_raw"])
    assert "the process that draws its images has ended" in capfd.readouterr().err
