"""Node `estimator` in a lockstep played by the test: one odometry per step, VIO only when released, status, costs."""

import numpy as np
import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from nav_msgs.msg import Odometry
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, nanoseconds, odometry_arrays, to_point, to_quaternion, to_stamp, to_vector
from perch_msgs.msg import EstimatorStatus, Release, Step, VioState
from perch_perception import estimator_node
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Imu

STEP_NS = 2_000_000
LEVEL = np.array([0.0, 0.0, 0.0, 1.0])


class Vehicle:
    """The test's side of the lockstep: IMU at rest, VIO at a fixed pose."""

    def __init__(self, context, executor):
        self.node = rclpy.create_node("test_vehicle", context=context)
        executor.add_node(self.node)
        self.executor, self.index, self.vio_count, self.state_count = executor, 0, 0, 0
        self.odometry, self.status, self.diagnostics = [], [], []
        self.imu_publisher = self.node.create_publisher(Imu, "imu/data_raw", qos.CHAIN)
        self.vio_publisher = self.node.create_publisher(Odometry, "vio/odometry", qos.GATED)
        self.state_publisher = self.node.create_publisher(VioState, "vio/state", qos.GATED)
        self.step_publisher = self.node.create_publisher(Step, "step", qos.STEP)
        self.node.create_subscription(Odometry, "odometry", self.odometry.append, qos.CHAIN)
        self.node.create_subscription(EstimatorStatus, "estimator/status", self.status.append, qos.CHAIN)
        self.node.create_subscription(DiagnosticArray, "/diagnostics", self.diagnostics.append, qos.STATUS)

    def spin_until(self, condition, what):
        for _ in range(2000):
            if condition():
                return
            self.executor.spin_once(timeout_sec=0.01)
        raise AssertionError(f"never saw {what}")

    def step(self, gyro=(0.0, 0.0, 0.0), accel=(0.0, 0.0, 9.81), released=None, wait=True):
        imu = Imu()
        imu.header.stamp = to_stamp(self.index * STEP_NS)
        imu.angular_velocity.x, imu.angular_velocity.y, imu.angular_velocity.z = gyro
        imu.linear_acceleration.x, imu.linear_acceleration.y, imu.linear_acceleration.z = accel
        step = Step(stamp=imu.header.stamp, index=self.index, lockstep=True)
        step.released = [Release(topic="/vio/odometry", count=self.vio_count if released is None else released),
                         Release(topic="/vio/state", count=self.state_count)]
        self.imu_publisher.publish(imu)
        self.step_publisher.publish(step)
        self.index += 1
        if wait:
            stamp = nanoseconds(imu.header.stamp)
            self.spin_until(lambda: self.odometry and nanoseconds(self.odometry[-1].header.stamp) == stamp,
                            f"odometry of step {self.index - 1}")

    def send_vio(self, p):
        msg = Odometry()
        msg.header.stamp = to_stamp((self.index - 5) * STEP_NS)
        fill_odometry(msg, np.array(p, float), LEVEL, np.zeros(3), np.zeros(3))
        msg.pose.covariance = (np.eye(6) * 1e-6).ravel()
        self.vio_publisher.publish(msg)
        self.vio_count += 1

    def send_state(self, p, gyro_bias):
        msg = VioState(position=to_point(np.array(p, float)), orientation=to_quaternion(LEVEL), gyro_bias=to_vector(gyro_bias))
        msg.header.stamp = to_stamp((self.index - 5) * STEP_NS)
        msg.covariance = (np.eye(15) * 1e-6).ravel()
        self.state_publisher.publish(msg)
        self.state_count += 1


@pytest.fixture
def vehicle(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    executor = EventsExecutor(context=context)
    node = estimator_node.create(context=context)
    executor.add_node(node)
    driver = Vehicle(context, executor)
    driver.spin_until(lambda: driver.imu_publisher.get_subscription_count() > 0
                      and driver.step_publisher.get_subscription_count() > 0, "the estimator's subscriptions")
    yield driver
    driver.node.destroy_node()
    node.destroy_node()
    rclpy.shutdown(context=context)


def test_answers_every_step_with_odometry_of_the_same_stamp(vehicle):
    for _ in range(120):
        vehicle.step()
    first = vehicle.odometry[0]
    assert (first.header.frame_id, first.child_frame_id) == ("map", "base_link")
    assert first.pose.covariance[0] > 1e4, "the position is unknown before VIO"
    vehicle.send_vio([1.0, 2.0, 0.5])
    for _ in range(30):
        vehicle.step()
    stamps = [nanoseconds(m.header.stamp) for m in vehicle.odometry]
    assert stamps == [k * STEP_NS for k in range(150)]
    p, q, v, _ = odometry_arrays(vehicle.odometry[-1])
    np.testing.assert_allclose(p, [1.0, 2.0, 0.5], atol=0.01)
    np.testing.assert_allclose(v, 0.0, atol=0.02)
    covariance = np.array(vehicle.odometry[-1].pose.covariance).reshape(6, 6)
    assert 0 < covariance[0, 0] < 1e-3 and np.linalg.eigvalsh(covariance)[0] > 0
    assert vehicle.status[0].state == EstimatorStatus.INITIALISING


def test_vio_counts_only_from_the_step_that_releases_it(vehicle):
    for _ in range(120):
        vehicle.step(released=0)
    vehicle.send_vio([3.0, 0.0, 0.0])
    for _ in range(20):
        vehicle.step(released=0)
    assert vehicle.odometry[-1].pose.covariance[0] > 1e4
    vehicle.step(released=1)
    assert odometry_arrays(vehicle.odometry[-1])[0][0] == pytest.approx(3.0, abs=0.01)


def test_reports_coasting_and_costs(vehicle):
    for _ in range(120):
        vehicle.step()
    vehicle.send_vio([0.0, 0.0, 0.0])
    for _ in range(900):
        vehicle.step()
    states = [m.state for m in vehicle.status]
    assert states[0] == EstimatorStatus.INITIALISING and EstimatorStatus.RUNNING in states
    assert states[-1] == EstimatorStatus.COASTING
    assert vehicle.status[-1].position_sigma > vehicle.status[-8].position_sigma
    stamps = np.diff([nanoseconds(m.header.stamp) for m in vehicle.status])
    np.testing.assert_array_equal(stamps, 100_000_000)
    vehicle.spin_until(lambda: len(vehicle.diagnostics) >= 2, "diagnostics")
    keys = {v.key for v in vehicle.diagnostics[-1].status[0].values}
    assert {"imu_step_us_median", "imu_step_us_p99", "vio_update_us_median"} <= keys


def test_broken_samples_still_get_an_answer(vehicle):
    for _ in range(120):
        vehicle.step()
    vehicle.send_vio([0.0, 0.0, 0.0])
    for k in range(40):
        vehicle.step(gyro=(float("nan"),) * 3 if k % 3 == 0 else (0.0, 0.0, 0.0))
    last = vehicle.odometry[-1]
    assert np.isfinite(np.concatenate(odometry_arrays(last))).all()


def test_a_parameter_out_of_range_is_refused_by_name(ros_domain):
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=ros_domain)
    try:
        with pytest.raises(ConfigError, match=r"gate_probability.*2"):
            estimator_node.create(context=context, parameter_overrides=[Parameter("gate_probability", value=2.0)])
    finally:
        rclpy.shutdown(context=context)


def test_vios_whole_state_comes_before_its_odometry(vehicle):
    """Its biases are taken with it; odometry beside it, which says less, is not used while states come."""
    for _ in range(120):
        vehicle.step()
    vehicle.send_state([1.0, 0.0, 0.0], np.array([0.0, 0.0, 0.02]))
    vehicle.send_vio([9.0, 0.0, 0.0])
    for _ in range(200):
        vehicle.step()
    assert odometry_arrays(vehicle.odometry[-1])[0][0] == pytest.approx(1.0, abs=0.01)
    assert vehicle.status[-1].gyro_bias.z == pytest.approx(0.02, abs=1e-6)
    assert (vehicle.status[-1].updates_accepted, vehicle.status[-1].updates_rejected) == (1, 0)


def test_odometry_counts_again_when_states_have_ended(vehicle):
    for _ in range(120):
        vehicle.step()
    vehicle.send_state([1.0, 0.0, 0.0], np.zeros(3))
    for _ in range(520):
        vehicle.step()
    vehicle.send_vio([1.01, 0.0, 0.0])
    for _ in range(60):
        vehicle.step()
    assert vehicle.status[-1].updates_accepted == 2
