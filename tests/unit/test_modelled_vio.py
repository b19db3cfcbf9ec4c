"""The stand-in for VIO: answers for each frame, a covariance that its errors obey, and input that it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.values import CameraModel, OdometryState, rotated
from perch_core.vehicle import load_vehicle
from perch_sim import modelled_vio, seeding, vio_model
from perch_sim.calibration import true_imu
from perch_sim.imu import Imu
from perch_sim.modelled_vio import ModelledVio
from perch_sim.vio_model import VioModelParameters

MS = 1_000_000
START = 1_000 * MS
OFFSET = round(load_vehicle("snapdragon").mounts["down"].stamp_offset * 1e9)
CAMERA = load_vehicle("snapdragon").mounts["down"].camera


def truth(stamp: int) -> OdometryState:
    """A circle of 1 m, 2 m from the origin, at 1 m/s, banked."""
    t = (stamp - START) * 1e-9
    q = tuple(so3.quat_multiply(so3.quat_exp(np.array([0.0, 0.0, t])), so3.quat_exp(np.array([0.1, -0.3, 0.0]))).tolist())
    v = (-np.sin(t), np.cos(t), 0.0)
    zero = np.zeros((6, 6))
    return OdometryState(stamp, (2.0 + np.cos(t), np.sin(t), 1.0), q, rotated(q, v, -1.0), (0.0, 0.0, 1.0), zero, zero)


def model(**parameters) -> tuple[ModelledVio, list, list, list]:
    vio = ModelledVio(VioModelParameters(**parameters))
    out = [], [], []
    for port, seen in zip((vio.state, vio.odometry, vio.log), out):
        port.receivers.append(seen.append)
    return vio, *out


def frame(stamp: int) -> CameraModel:
    return CameraModel(stamp, "camera_down_optical_frame", CAMERA)


def fly(vio: ModelledVio, seconds: float, every: int = 15) -> None:
    for k in range(1, round(seconds * 500)):
        stamp = START + 2 * MS * k
        vio.on_truth(truth(stamp))
        if k % every == 0:
            vio.on_camera_info(frame(stamp - 12 * MS))


def test_each_frame_is_answered_once_with_the_middle_of_its_exposure_on_the_imus_clock():
    vio, states, odometry, _ = model()
    fly(vio, 1.0)
    assert [s.stamp for s in states] == [o.stamp for o in odometry] == [START + 2 * MS * k - 12 * MS - OFFSET for k in range(15, 500, 15)]
    for s, o in zip(states, odometry):
        assert tuple(s.p_WB.tolist()) == o.p_WB and tuple(s.q_WB.tolist()) == o.q_WB and np.allclose(s.v_WB, o.v_WB, atol=1e-12)
        assert s.frame == o.frame == "odom"
        true = truth(s.stamp)
        assert np.linalg.norm(np.subtract(o.p_WB, true.p_WB)) < 0.05 and np.linalg.norm(np.subtract(o.v_WB, true.v_WB)) < 0.2


def test_in_real_time_answers_come_after_their_latency_by_the_stamps_of_the_truth():
    vio, states, _, _ = model(latency=0.04)
    came = []
    for k in range(1, 200):
        stamp = START + 2 * MS * k
        if k == 100:
            vio.on_camera_info(frame(stamp - 12 * MS))
        vio.on_truth(truth(stamp))
        came += [stamp] * (len(states) - len(came))
    assert len(came) == 1 and 0 <= came[0] - (states[0].stamp + 40 * MS) < 2 * MS


@pytest.mark.slow
def test_its_whole_state_is_as_wrong_as_its_covariance_says(monkeypatch):
    """Over seeds, 15 errors whitened by the covariance have unit variance; so have those that the drift of yaw correlates."""
    monkeypatch.setattr(vio_model, "YAW_DRIFT", 0.005)
    nees, pairs = [], []
    for seed in range(120):
        vio, states, _, _ = model(seed=seed)
        vio.on_truth(truth(START + 2 * MS)), vio.on_truth(truth(START + 4 * MS))
        vio.on_camera_info(frame(START + 3 * MS + OFFSET))
        stamp = START + 20_000 * MS
        for k in range(-40, 1):
            vio.on_truth(truth(stamp + 2 * MS * k))
        vio.on_camera_info(frame(stamp - 20 * MS + OFFSET))
        s = states[-1]
        true = truth(s.stamp)
        config = true_imu(load_vehicle("snapdragon").imu, seed)
        imu = Imu(config, seeding.stream(seed, "imu"))
        theta = so3.quat_log(so3.quat_multiply(so3.quat_conjugate(s.q_WB), np.array(true.q_WB)))
        walked = np.random.default_rng(seed).standard_normal(6) * np.sqrt(19.98) * np.repeat([config.gyro_bias_walk, config.accel_bias_walk], 3)
        error = np.concatenate([true.p_WB - s.p_WB, true.v_WB - s.v_WB, theta, imu.bias[3:] + walked[:3] - s.gyro_bias,
                                imu.bias[:3] + walked[3:] - s.accel_bias])
        assert np.linalg.eigvalsh(s.covariance).min() > 0.0 and np.array_equal(s.covariance, s.covariance.T)
        nees.append(error @ np.linalg.solve(s.covariance, error))
        pairs.append(np.linalg.solve(np.linalg.cholesky(s.covariance[:9, :9]), error[:9]))
    assert np.mean(nees) == pytest.approx(15.0, rel=0.1)  # 120 draws of 15 degrees of freedom: 1 sigma is 3.3 %
    assert np.cov(np.array(pairs).T) == pytest.approx(np.eye(9), abs=0.4)


def test_input_that_cannot_be_used_is_named_and_dropped():
    vio, states, _, log = model()
    fly(vio, 0.2)
    before, log[:] = len(states), []
    vio.on_truth(truth(START + 400 * MS)._replace(p_WB=(float("nan"), 0.0, 0.0)))
    vio.on_truth(truth(START + 402 * MS)._replace(q_WB=(0.0,) * 4))
    vio.on_camera_info(frame(START + 5_000 * MS))   # ahead
    vio.on_camera_info(frame(START + 100 * MS))     # back
    assert len(states) == before and [line.level for line in log] == ["warning"] * 4
    vio.on_truth(truth(START + 600 * MS))
    vio.on_camera_info(frame(START + 590 * MS))
    assert len(states) == before + 1


def test_a_flight_that_begins_anew_is_answered_anew():
    vio, states, _, log = model()
    fly(vio, 0.5)
    before = len(states)
    fly(vio, 0.5)
    assert len(states) == 2 * before and any("estimator reset" in line.text for line in log)
    for first, again in zip(states[:before], states[before:]):  # without the drift of the flight before, nor its age
        assert np.array_equal(first.p_WB, again.p_WB) and np.array_equal(first.covariance, again.covariance)
    assert all(np.diag(state.covariance).min() > 0.0 for state in states)


def test_a_camera_that_there_is_not_is_refused(monkeypatch):
    monkeypatch.setattr(modelled_vio, "CAMERA", "rear")
    with pytest.raises(ConfigError, match="snapdragon has no camera 'rear'"):
        model()
