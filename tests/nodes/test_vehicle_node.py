"""Node `vehicle`: lockstep with a scripted controller, stamps and rates, the stand-in VIO, and what goes wrong."""

from __future__ import annotations

import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import rclpy
from nodes.vehicle_flight import seen_steps, stamps
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import nanoseconds, odometry_arrays, pose_arrays
from perch_core.ros.lockstep import Participant
from perch_core.scenario import load_scenario
from perch_core.timing import TICK_STEPS
from perch_core.vehicle import load_vehicle
from nav_msgs.msg import Odometry
from perch_msgs.msg import Contact, MotorCommand, Step
from rclpy.experimental import EventsExecutor
from sensor_msgs.msg import Imu


def test_publishes_every_topic_at_its_rate_and_flies_on_commands(flights):
    seen = flights().fly(500)
    steps = [nanoseconds(m.stamp) for m in seen["step"]][:500]
    assert [m.index for m in seen["step"]][:500] == list(range(500))
    assert all(m.lockstep for m in seen["step"]) and set(np.diff(steps)) == {2_000_000}
    np.testing.assert_array_equal(stamps(seen["imu/data_raw"])[:500], steps)
    np.testing.assert_array_equal(stamps(seen["ground_truth/odometry"])[:500], steps)
    assert len(seen["rotor_state"]) in (100, 101) and len(seen["/clock"]) in (100, 101)
    heights = [odometry_arrays(m)[0][2] for m in seen["ground_truth/odometry"]]
    assert heights[-1] > heights[0] + 0.1
    assert [m.state for m in seen["contact"]][:2] == [Contact.GROUND, Contact.NONE]
    surface = load_scenario("surface_90").surface
    np.testing.assert_allclose(pose_arrays(seen["ground_truth/target"][0].pose)[0], surface.p_WS)
    frames = seen["camera_front/camera_info"]
    assert 28 <= len(frames) <= 30 and frames[0].distortion_model == "equidistant"
    assert list(frames[0].d) == list(load_vehicle("snapdragon").mounts["front"].camera.distortion)
    assert not seen["camera_front/image_raw"]  # the cameras are off


def test_truth_gives_its_twist_in_the_body_frame(flights):
    """`nav_msgs/Odometry`: turned back to the map, the twist is the derivative of the position."""
    seen = flights().fly(300)["ground_truth/odometry"]
    p = np.array([odometry_arrays(m)[0] for m in seen])
    v = np.array([odometry_arrays(m)[2] for m in seen])
    np.testing.assert_allclose((p[251] - p[249]) / 0.004, v[250], atol=2e-3)
    assert (seen[0].header.frame_id, seen[0].child_frame_id) == ("map", "base_link")


def test_vio_stand_in_counts_forty_milliseconds_after_the_exposure(flights):
    """Its results are released at the first step after exposure + latency, whenever they were published."""
    seen = flights(vio=True).fly(400)
    releases = [(nanoseconds(m.stamp), r.count) for m in seen["step"] for r in m.released if r.topic == "/vio/odometry"]
    assert releases[0][1] == 0 and [count for _, count in releases] == list(range(len(releases)))
    exposed = stamps(seen["vio/odometry"])
    assert len(releases) > 20
    for step, count in releases[1:]:
        assert 0.038e9 <= step - exposed[count - 1] < 0.046e9  # 40 ms, a time offset of 2 ms, one step
    p, _, v, _ = odometry_arrays(seen["vio/odometry"][count - 1])
    truth = {nanoseconds(m.header.stamp): odometry_arrays(m) for m in seen["ground_truth/odometry"]}
    nearest = truth[min(truth, key=lambda t: abs(t - exposed[count - 1]))]
    assert np.linalg.norm(p - nearest[0]) < 0.05 and np.linalg.norm(v - nearest[2]) < 0.2


def test_same_seed_same_messages(flights):
    """Compared as messages: the bytes on the wire hold padding that nobody writes."""
    def record(seed):
        flight = flights(vio=True, seed=seed)
        seen = flight.fly(200)
        flight.close()
        counts = {"imu/data_raw": 200, "ground_truth/odometry": 200, "camera_down/camera_info": 4, "vio/odometry": 4}
        return {topic: seen[topic][:count] for topic, count in counts.items()}

    first = record(5)
    assert record(5) == first
    assert record(6)["imu/data_raw"] != first["imu/data_raw"]


def test_a_silent_controller_is_named_and_dropped_and_its_motors_stop(flights, capfd):
    flight = flights(silent_after=100, lockstep_timeout=0.3)
    seen = flight.fly(260)
    assert flight.answered == 100
    lines = [line for line in capfd.readouterr().err.splitlines() if "dropped" in line]
    assert len(lines) == 1 and "controller (or the estimator before it) silent for 0.3 s" in lines[0]
    last = seen["rotor_state"][-1]
    assert max(last.rotor_speed) < 500.0  # 100 ms after the last command the motors were off


def test_a_participant_that_never_comes_is_named_and_dropped(flights, capfd):
    flight = flights(participants=["controller", "mission"], start_timeout=0.5)
    flight.fly(20)
    lines = [line for line in capfd.readouterr().err.splitlines() if "dropped" in line]
    assert len(lines) == 1 and "mission did not come within 0.5 s" in lines[0]


def test_the_flight_waits_for_the_first_report_of_a_participant_that_lives(flights):
    """A mission that holds its first tick until there is a goal holds the flight, beyond any time-out."""
    flight = flights(participants=["controller", "mission"], lockstep_timeout=0.2)
    mission = rclpy.create_node("mission", context=flight.context)
    flight.nodes.append(mission)
    ticks = []
    side = Participant(mission, ticks.append, every=TICK_STEPS)
    flight.executor.add_node(mission)
    side.greet()
    for _ in range(400):
        flight.executor.spin_once(timeout_sec=0.01)
    assert [m.index for m in seen_steps(flight)] == list(range(5))  # the result of tick 0 is due 10 ms later
    side.report(ticks[0].stamp)
    for _ in range(200):
        flight.executor.spin_once(timeout_sec=0.02)
        if len(seen_steps(flight)) >= 15:
            break
    assert len(seen_steps(flight)) == 15


def test_commands_that_are_no_numbers_are_refused(flights, capfd):
    flight = flights()
    flight.answer = None
    flight.fly(10)
    bad = MotorCommand(armed=True, rotor_speed=[float("nan")] * 4)
    flight.commands.publish(bad)
    flight.fly(len(flight.seen["step"]) + 20)
    assert "motor_command: rotor_speed [nan, nan, nan, nan] is not finite" in capfd.readouterr().err


@pytest.mark.parametrize("name, value, message", [
    ("cameras", "left", "'left' is not one of all, down, front, none"),
    ("seed", -1, "-1 is outside"), ("scenario", "nowhere", "unknown; there are"),
    ("participants", ["controler"], "'controler' is not one of controller"), ("sed", 1, "unknown parameter"),
])
def test_refuses_parameters_with_their_place_and_range(flights, ros_domain, name, value, message):
    with pytest.raises(ConfigError, match=message):
        flights(**{name: value})


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_alone_in_its_process_it_is_heard_in_real_time_and_ends_cleanly_on_signals(ros_domain, number):
    code = "from perch_sim.vehicle_node import main; main()"
    arguments = ["--ros-args", "-p", "lockstep:=false", "-p", "cameras:=none"]
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    node = rclpy.create_node("listener", context=context)
    executor = EventsExecutor(context=context)
    executor.add_node(node)
    steps, ticks, samples, truth = [], [], [], []
    node.create_subscription(Step, "step", steps.append, qos.STEP)
    node.create_subscription(Step, "tick", ticks.append, qos.STEP)
    node.create_subscription(Imu, "imu/data_raw", samples.append, qos.CHAIN)
    node.create_subscription(Odometry, "ground_truth/odometry", truth.append, qos.CHAIN)
    process = subprocess.Popen([sys.executable, "-c", code, *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        end = time.monotonic() + 30.0
        while time.monotonic() < end:
            if len(steps) > 50 and len(ticks) > 4 and min(len(samples), len(truth)) > 50:
                break
            executor.spin_once(timeout_sec=0.05)
        process.send_signal(number)
        out, err = process.communicate(timeout=20)
    finally:
        process.kill()
        node.destroy_node()
        rclpy.shutdown(context=context)
    assert len(steps) > 50 and not steps[0].lockstep
    assert len(ticks) > 4 and set(np.diff([t.index for t in ticks])) == {TICK_STEPS}
    assert min(len(samples), len(truth)) > 50
    assert process.returncode == 0 and "Traceback" not in out + err
