"""Node `controller` in a lockstep played by the test: a command per step, refusals, services, status, switching laws."""

from __future__ import annotations

import numpy as np
import pytest
import rclpy
from closed_loop.plant import Plant
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from perch_control import controller_node
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, to_stamp
from perch_core.ros.trajectories import flat_message
from perch_core.trajectory import rest_to_rest
from perch_core.vehicle import load_vehicle
from perch_msgs.msg import ControllerCommand, ControllerStatus, ControlReference, MotorCommand, Step, Trajectory
from perch_msgs.srv import SetController
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu
from std_srvs.srv import Trigger

STEP_NS = 2_000_000


class Vehicle:
    """The test's side of the lockstep: a plant whose true state is the odometry."""

    def __init__(self, context, executor):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.index = executor, 0
        self.plant = Plant(load_vehicle("snapdragon"), np.zeros(3), speed=np.zeros(4))
        self.commands, self.status, self.references, self.diagnostics = [], [], [], []
        create = self.node.create_publisher
        self.odometry, self.steps = create(Odometry, "odometry", qos.CHAIN), create(Step, "step", qos.STEP)
        self.imu = create(Imu, "imu/data_raw", qos.CHAIN)
        self.orders = create(ControllerCommand, "controller/command", qos.GATED)
        self.trajectories = create(Trajectory, "trajectory", qos.GATED)
        self.node.create_subscription(MotorCommand, "motor_command", self.commands.append, qos.CHAIN)
        self.node.create_subscription(ControllerStatus, "controller/status", self.status.append, qos.CHAIN)
        self.node.create_subscription(ControlReference, "controller/reference", self.references.append, qos.CHAIN)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, qos.STATUS)
        self.abort = self.node.create_client(Trigger, "abort")
        self.choose = self.node.create_client(SetController, "set_controller")

    def spin_until(self, condition, what):
        for _ in range(3000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    @property
    def time(self):
        return self.index * STEP_NS * 1e-9

    def step(self, count=1, position=None, quaternion=None):
        for _ in range(count):
            s = np.array(self.plant.state)
            odometry = Odometry()
            odometry.header.stamp = to_stamp(self.index * STEP_NS)
            fill_odometry(odometry, s[:3] if position is None else position,
                          s[6:10] if quaternion is None else quaternion, s[3:6], s[10:])
            imu = Imu()
            imu.header.stamp = odometry.header.stamp
            imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z = self.plant.w.tolist()
            force = imu.linear_acceleration
            force.x, force.y, force.z = self.plant.specific_force_B.tolist()
            self.imu.publish(imu)
            self.odometry.publish(odometry)
            self.steps.publish(Step(stamp=odometry.header.stamp, index=self.index, lockstep=True))
            wanted = self.index * STEP_NS
            self.spin_until(lambda: self.commands and nanoseconds(self.commands[-1].header.stamp) == wanted,
                            f"command of step {self.index}")
            command = self.commands[-1]
            self.plant.advance(np.array(command.rotor_speed) if command.armed else np.zeros(4))
            self.index += 1

    def order(self, command, reason="test"):
        self.orders.publish(ControllerCommand(command=command, reason=reason))
        self.settle()

    def fly(self, trajectory, id=1, at_end=Trajectory.AT_END_HOLD, change=None):
        msg = flat_message(trajectory)
        msg.id, msg.at_end = id, at_end
        if change:
            change(msg)
        self.trajectories.publish(msg)
        self.settle()

    def settle(self):
        """Let what was published arrive before the next step: these topics have no participant that would gate them."""
        for _ in range(20):
            self.executor.spin_once(timeout_sec=0.005)

    def call(self, client, request):
        self.spin_until(client.service_is_ready, "the service")
        future = client.call_async(request)
        self.spin_until(future.done, "the answer")
        return future.result()

    def state(self):
        self.step(10)
        self.settle()
        return self.status[-1].state

    def take_off(self):
        self.step(20)
        self.order(ControllerCommand.ARM)
        self.step(2)
        self.fly(rest_to_rest(np.zeros(3), np.array([0, 0, 0.5]), 0.0, 0.0, 0.9, start_time=self.time + 0.02), id=5)
        self.step(500)


@pytest.fixture
def vehicle(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    executor = EventsExecutor(context=context)
    node = controller_node.create(
        context=context, parameter_overrides=[Parameter("estimator_status", value=False)])
    executor.add_node(node)
    driver = Vehicle(context, executor)
    driver.node_under_test = node
    driver.spin_until(lambda: all(p.get_subscription_count() for p in
                                  (driver.odometry, driver.imu, driver.steps, driver.orders, driver.trajectories)), "subscriptions")
    yield driver
    driver.node.destroy_node()
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_answers_every_step_also_when_disarmed(vehicle):
    vehicle.step(60)
    assert [nanoseconds(c.header.stamp) for c in vehicle.commands] == [k * STEP_NS for k in range(60)]
    assert not any(c.armed for c in vehicle.commands)
    vehicle.settle()
    assert [nanoseconds(s.header.stamp) for s in vehicle.status] == [k * STEP_NS for k in range(0, 60, 10)]
    assert vehicle.status[0].state == ControllerStatus.DISARMED and vehicle.status[0].controller == "geometric"


def test_takes_off_follows_switches_and_lands(vehicle):
    vehicle.take_off()
    assert vehicle.plant.p[2] == pytest.approx(0.5, abs=0.03)
    assert vehicle.state() == ControllerStatus.HOVERING and vehicle.status[-1].trajectory_id == 5
    assert any(r.trajectory_id == 5 for r in vehicle.references)
    keys = {v.key for v in vehicle.diagnostics[-1].status[0].values}
    assert "step_us_median" in keys and "missed_deadlines" not in keys  # the wall clock means nothing in lockstep

    answer = vehicle.call(vehicle.choose, SetController.Request(type="pid"))
    assert not answer.success and answer.error_code == 1 and "geometric, nmpc" in answer.message
    vehicle.spin_until(lambda: vehicle.node_under_test._assembly.nmpc is not None, "the compiled NMPC")
    before = np.array(vehicle.commands[-1].rotor_speed)
    answer = vehicle.call(vehicle.choose, SetController.Request(type="nmpc", adaptive=True))
    assert answer.success, answer.message
    vehicle.step(1)
    assert np.abs(np.array(vehicle.commands[-1].rotor_speed) - before).max() < 0.05 * before.max(), "no jump"
    vehicle.step(100)
    vehicle.state()
    assert vehicle.status[-1].controller == "nmpc+l1"
    assert np.linalg.norm(vehicle.plant.v) < 0.05

    vehicle.order(ControllerCommand.LAND)
    vehicle.step(1500)
    assert vehicle.state() == ControllerStatus.DISARMED
    assert not vehicle.commands[-1].armed and vehicle.plant.p[2] < 0.02


def test_refuses_bad_trajectories_and_says_why(vehicle):
    vehicle.take_off()
    start = vehicle.time + 0.1

    def good():
        return rest_to_rest(np.array([0, 0, 0.5]), np.array([1, 0, 0.5]), 0.0, 0.0, 2.0, start_time=start)

    cases = {
        "finite": lambda m: m.segments[0].x.__setitem__(0, float("nan")),
        "unequal": lambda m: m.segments[0].x.append(1.0),
        "neither": lambda m: m.segments.clear(),
        "away": lambda m: [m.segments[0].x.__setitem__(k, m.segments[0].x[k] + 2.0) for k in range(len(m.segments[0].x))],
        "past": lambda m: setattr(m.header, "stamp", to_stamp(max(0.0, start - 2.0))),
        "frame_id": lambda m: setattr(m.header, "frame_id", "odom"),
        "at_end": lambda m: setattr(m, "at_end", 9),
    }
    for word, change in cases.items():
        vehicle.step(10)
        vehicle.fly(good(), id=99, change=change)
        assert vehicle.state() == ControllerStatus.HOVERING
        assert "refused" in vehicle.status[-1].message and word in vehicle.status[-1].message, vehicle.status[-1].message
    assert np.linalg.norm(vehicle.plant.v) < 0.05


def test_disarm_in_flight_is_refused_kill_is_not(vehicle):
    vehicle.take_off()
    vehicle.order(ControllerCommand.DISARM)
    vehicle.step(5)
    assert vehicle.commands[-1].armed
    vehicle.order(ControllerCommand.KILL, "test of the kill switch")
    vehicle.step(2)
    assert not vehicle.commands[-1].armed
    assert vehicle.state() == ControllerStatus.FAILED and "kill switch" in vehicle.status[-1].message


def test_abort_brakes_to_a_hover(vehicle):
    vehicle.take_off()
    vehicle.fly(rest_to_rest(np.array([0, 0, 0.5]), np.array([2, 0, 0.5]), 0.0, 0.0, 2.0, start_time=vehicle.time + 0.02))
    vehicle.step(500)
    answer = vehicle.call(vehicle.abort, Trigger.Request())
    assert answer.success and "abort" in answer.message
    vehicle.step(500)
    assert vehicle.state() == ControllerStatus.HOVERING and np.linalg.norm(vehicle.plant.v) < 0.05
    # From the 2.2 m/s of mid-way, braking at 4 m/s^2 at the peak takes 1.2 m.
    assert vehicle.plant.p[0] < 2.6


def test_unusable_odometry_still_gets_its_answer(vehicle):
    vehicle.take_off()
    vehicle.step(10, position=np.full(3, np.nan))
    assert vehicle.commands[-1].armed, "bridged"
    vehicle.step(5)
    vehicle.step(20, quaternion=np.array([0, 0, 0, 0.4]))
    vehicle.step(30, quaternion=np.array([0, 0, 0, 0.4]))
    assert vehicle.state() == ControllerStatus.LANDING and "without position" in vehicle.status[-1].message


def test_gains_change_in_flight_and_bad_ones_are_refused(vehicle):
    vehicle.take_off()
    node = vehicle.node_under_test
    ok, = node.set_parameters([Parameter("snapdragon.position", value=[5.0, 5.0, 6.0])])
    assert ok.successful and node._assembly.flight.law.gains.position == (5.0, 5.0, 6.0)
    for name, value, word in (("snapdragon.lead", 5.0, "0.2"), ("snapdragon.position", [1.0], "3"),
                              ("vehicle", "rpg", "fixed"), ("nmpc.nodes", 30, "fixed")):
        if name.startswith("nmpc"):
            vehicle.spin_until(lambda: node._assembly.nmpc is not None, "the compiled NMPC")
        refused, = node.set_parameters([Parameter(name, value=value)])
        assert not refused.successful and word in refused.reason, refused.reason
    vehicle.step(200)
    assert np.linalg.norm(vehicle.plant.v) < 0.05


def test_unknown_parameter_is_refused_at_the_start(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        with pytest.raises(ConfigError, match="unknown"):
            controller_node.create(context=context, parameter_overrides=[Parameter("gain", value=1.0)])
    finally:
        rclpy.shutdown(context=context)
