"""A flight along a known path, as values and as a file."""

import math

import cv2
import numpy as np

from perch_core.trajectory import rest_to_rest
from perch_core.urdf import urdf
from perch_core.values import (
    AtEnd, CompressedPixels, Contact, ControllerCommand, ControllerStatus, ControlReference, EstimatorHealth, MotorCommand, OdometryState,
    PoseStamped, RotorState, TargetPose, TrajectoryOrder, rotated)
from perch_core.vehicle import load_vehicle
from perch_eval.flight import timed
from perch_eval.ros.recorded_flight import write

STEP = 2_000_000  # [ns]
STEPS = range(500, 2000)
ZERO = np.zeros((6, 6))
PATH = rest_to_rest([0.0, 0.0, 1.0], [2.0, 0.0, 1.0], 0.0, 0.0, 2.0, start_time=1.5)
BIAS = np.array([0.03, 0.0, -0.01])  # of the estimate [m]


def flown():
    """Channels of a flight along a known path: the estimate is off by `BIAS`, the target by 4 cm, contact at 3.4 s."""
    out = {name: [] for name in ("ground_truth/odometry", "odometry", "motor_command", "rotor_state", "controller/reference")}
    for k in STEPS:
        stamp = k * STEP
        sample = PATH.sample(min(max(k * 0.002 - 1.5, 0.0), PATH.duration))
        q = (0.0, math.sin(0.1), 0.0, math.cos(0.1))
        v_B = rotated(q, tuple(sample.v), -1.0)
        out["ground_truth/odometry"].append(OdometryState(stamp, tuple(sample.p), q, v_B, (0.0, 0.5, 0.0), ZERO, ZERO))
        out["odometry"].append(OdometryState(stamp, tuple(sample.p + BIAS), q, v_B, (0.0, 0.5, 0.0), 1e-4 * np.eye(6), 1e-4 * np.eye(6)))
        out["motor_command"].append(MotorCommand(stamp, True, (1200.0,) * 4))
        if k % 5 == 0:
            out["rotor_state"].append(RotorState(stamp, (1200.0,) * 4, (0.6,) * 4))
        if k >= 750:
            zero = (0.0,) * 3
            out["controller/reference"].append(ControlReference(stamp, 1, tuple(sample.p), q, tuple(sample.v), zero, zero, zero, 2.4, zero))
    image = np.full((48, 64), 120, np.uint8)
    packed = cv2.imencode(".jpg", image)[1].tobytes()
    out |= {
        "ground_truth/target": [PoseStamped(1_000_000_000, (2.0, 0.0, 1.0), (0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)))],
        "target/pose": [TargetPose(1_200_000_000, np.array([2.0, 0.04, 1.0]), np.array([0.0, -math.sqrt(0.5), 0.0, math.sqrt(0.5)]), 1e-4 * np.eye(6))],
        "trajectory": [TrajectoryOrder(1, PATH, AtEnd.CONTACT, 0.25)],
        "contact": [Contact(1_100_000_000, 0, "ground", 0.0, 0.0, 0.0, 0.0, ""), Contact(3_400_000_000, 1, "pad", 0.7, 0.1, 0.02, 0.03, "")],
        "controller/command": [ControllerCommand(1_000_000_000, 1, "take-off")],
        "controller/status": [ControllerStatus(k * STEP, 3, "geometric", 1, 0.0, 2.0, 0.0, 0.0, 0.5, 1.0, "tracking") for k in STEPS[::10]],
        "estimator/status": [EstimatorHealth(k * STEP, 1, 0.02, k, 0, 3.0, (0.0,) * 3, (0.0,) * 3, 0.01, 0.01, "") for k in STEPS[::50]],
        "camera_front/image_raw/compressed": [CompressedPixels(k * STEP, "camera_front_optical_frame", "jpeg", packed) for k in STEPS[::100]],
    }
    return {channel: timed(values) for channel, values in out.items()} | {"robot_description": [(1.0, urdf(load_vehicle("snapdragon")))]}


def record(path, channels):
    """The same as a file, in the order of time."""
    write(path, sorted(((channel, round(1e9 * t), value) for channel, values in channels.items() for t, value in values), key=lambda item: item[1]))
