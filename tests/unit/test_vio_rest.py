"""Standing still as VIO sees it before it sees anything: on the ground, after a shake, and when the vehicle has gone for good."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from perch_core import so3
from perch_core.values import RotorState
from perch_core.vehicle import load_vehicle
from perch_perception.ukf import ImuSample
from perch_perception.vio import FrameOutcome, VioConfig, VisualInertialOdometry
from perch_perception.vio.start import CONFIGURED_POSE_SIGMA

MS = 1_000_000


def blank(rng, level=110, noise=4):
    """Images in turn in which there is nothing but noise: a few are made, of which no two that follow each other are alike."""
    some = [np.clip(rng.normal(level, noise, (480, 640)), 0, 255).astype(np.uint8) for _ in range(4)]
    return lambda frame: some[frame % 4]


def textured(rng, noise=2.0):
    """The same, of a floor that is seen."""
    texture = cv2.GaussianBlur(rng.normal(128, 200, (480, 640)), (0, 0), 3.0)
    some = [np.clip(texture + rng.normal(0.0, noise, texture.shape), 0, 255).astype(np.uint8) for _ in range(4)]
    return lambda frame: some[frame % 4]


def rotors(stamp, turn):
    """Rotors that idle, or stand."""
    return RotorState(stamp, (600.0 * turn,) * 4, (0.4 * turn,) * 4)


def outcomes(climb, drop, until=2.6, idle=0.0, turn=lambda t: None):
    """Frames over a blank floor: rest for 1 s, `climb` and `drop` [m/s^2] for 0.1 s each, then nothing more; (time, outcome, height).

    Rotors shake the vehicle from the end of the rest for a time `idle` [s]; `turn(t)`: whether they are reported to turn, None: no report.
    """
    rng, mount = np.random.default_rng(1), load_vehicle("snapdragon").mounts["down"]
    vio, out, frame, image = VisualInertialOdometry(VioConfig(), mount), [], 0.1, blank(rng)
    for k in range(round(until / 0.002)):
        t = 0.002 * k
        up = 9.81 + (climb if 1.0 <= t < 1.1 else drop if 1.1 <= t < 1.2 else 0.0)
        shake = 1.0 if 1.0 <= t < 1.0 + idle else 0.05
        vio.add_imu(ImuSample(k * 2 * MS, tuple(rng.normal(0, 0.002, 3)), tuple(rng.normal(0, shake, 3) + [0, 0, up])))
        if turn(t) is not None:
            vio.add_rotors(rotors(k * 2 * MS, turn(t)))
        if t > frame + 0.02:
            result = vio.add_image(round(frame * 1e9), image(len(out)))
            out.append((frame, result.outcome, vio.filter.state.p_WB[2] if vio.filter else 0.0))
            frame += 1 / 30
    return out


@pytest.mark.slow
def test_a_shake_on_the_ground_is_rest_again():
    seen = outcomes(climb=1.5, drop=-1.5, turn=lambda t: False)
    assert {o for t, o, _ in seen if 0.5 < t < 1.0} == {FrameOutcome.RESTING}
    assert any(o is not FrameOutcome.RESTING for t, o, _ in seen if 1.0 < t < 1.3)
    assert {o for t, o, _ in seen if t > 1.8} == {FrameOutcome.RESTING}


@pytest.mark.slow
@pytest.mark.parametrize("climb, turn, rests", [
    (0.0, lambda t: 1.0 < t < 2.6, True), (0.0, lambda t: t > 1.0, False), (0.0, lambda t: None, False), (6.0, lambda t: t > 1.0, False),
    (0.0, lambda t: False if t < 1.0 else None, False)], ids=["stopped", "idle", "no report", "taken off", "an old report"])
def test_rotors_that_idled_on_the_ground_in_the_dark_leave_it_at_rest_once_they_stand(climb, turn, rests):
    """For longer than vision may be missing at a take-off."""
    seen = outcomes(climb, -climb, until=4.0, idle=1.6, turn=turn)
    assert any(o is FrameOutcome.BLIND for t, o, _ in seen if 2.0 < t < 2.6)
    assert {o for t, o, _ in seen if t > 3.0} == {FrameOutcome.RESTING if rests else FrameOutcome.BLIND}


@pytest.mark.parametrize("turn", [None, True, False], ids=["no report", "flown", "carried"])
def test_a_steady_climb_is_not_rest(turn):
    """Nothing to see and a quiet IMU, but a velocity that the filter knows: it was told to have stopped, and to be back on the ground."""
    seen = outcomes(climb=3.0, drop=0.0, turn=lambda t: turn and t > 1.0)
    late = [(o, z) for t, o, z in seen if t > 1.5]
    assert not any(o is FrameOutcome.RESTING for o, _ in late)
    assert late[-1][1] == pytest.approx(0.015 + 0.3 * (seen[-1][0] - 1.1), abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("leaves", ["never", "before", "meanwhile"])
def test_a_camera_that_was_silent_for_longer_than_the_imu_is_kept_is_used_again(leaves):
    """At rest it rests where it did. Where it moved when the images stopped or come back, position and heading are as uncertain as they then are.

    Only a floor that is seen shows that a vehicle that has moved rests again.
    """
    rng, mount, frame = np.random.default_rng(1), load_vehicle("snapdragon").mounts["down"], 0.1
    vio, seen, image = VisualInertialOdometry(VioConfig(), mount, np.array([0.5, 0.2, 1.0])), [], blank(rng)
    lit = textured(rng)
    for k in range(5500):
        t = 0.002 * k
        begin = {"never": np.inf, "before": 1.0, "meanwhile": 8.8}[leaves]
        up = 9.81 + (3.0 if begin <= t < begin + 0.4 else -3.0 if begin + 0.4 <= t < begin + 0.8 else 0.0)
        vio.add_imu(ImuSample(k * 2 * MS, tuple(rng.normal(0, 0.002, 3)), tuple(rng.normal(0, 0.05, 3) + [0, 0, up])))
        if t > frame + 0.02:
            if not 1.3 < frame < 9.0:
                floor = image if frame < 9.0 or leaves == "never" else lit
                seen.append((frame, vio.add_image(round(frame * 1e9), floor(len(seen)))))
            frame += 1 / 30
    before, after = (next(r for t, r in reversed(seen) if t < 1.0), seen[-1][1])
    assert before.outcome is FrameOutcome.RESTING is after.outcome, after.message
    sigma = np.sqrt(np.diag(after.estimate.pose_covariance))
    if leaves != "never":
        assert sigma[:3].max() > 1.0 and sigma[5] > 1.0
    else:
        np.testing.assert_allclose(after.estimate.p_WB, before.estimate.p_WB, atol=0.01)
        assert sigma[:3].max() < 0.05 and sigma[5] < 0.1


@pytest.mark.parametrize("leaves", [False, True])
def test_a_gap_in_the_imu_at_rest_is_bridged_by_images_that_have_not_moved(leaves):
    """0.4 s without samples. A vehicle that left meanwhile is seen in the image."""
    rng, mount, frame = np.random.default_rng(1), load_vehicle("snapdragon").mounts["down"], 0.1
    vio, seen = VisualInertialOdometry(VioConfig(), mount, np.array([0.5, 0.2, 1.0])), []
    texture = cv2.GaussianBlur(rng.normal(128, 200, (480, 700)), (0, 0), 3.0)
    for k in range(1300):
        t = 0.002 * k
        if not 1.4 < t < 1.8:
            vio.add_imu(ImuSample(k * 2 * MS, tuple(rng.normal(0, 0.002, 3)), tuple(rng.normal(0, 0.05, 3) + [0, 0, 9.81])))
        while frame + 0.02 < t and vio.covers(round(frame * 1e9)):
            column = round(60.0 * min(max(frame - 1.6, 0.0), 0.6)) if leaves else 0
            image = np.clip(texture[:, column:column + 640] + rng.normal(0.0, 2.0, (480, 640)), 0, 255).astype(np.uint8)
            seen.append((frame, vio.add_image(round(frame * 1e9), image)))
            frame += 1 / 30
    if leaves:
        assert any(r.outcome is not FrameOutcome.RESTING for t, r in seen if 1.6 < t < 1.85)
        return
    assert {r.outcome for t, r in seen if t > 0.8} == {FrameOutcome.RESTING}
    last = seen[-1][1].estimate
    np.testing.assert_allclose(last.p_WB[:2], [0.5, 0.2], atol=0.01)
    assert np.sqrt(np.diag(last.pose_covariance)).max() < 0.1  # none of it is the 0.6 rad of the gap


ATTITUDES = {"ground": np.zeros(3), "wall": np.array([0.1, -1.5, 0.2]), "upside down": np.array([3.0, 0.2, 0.0])}


def rest(seed, attitude, times, dark, fps=2.0, rate=100.0):
    """A vehicle that rests, whose IMU's biases walk; its camera sees noise, or nothing.

    Returns:
        The odometry; outcomes; error (15,) and covariance of (p, v, theta, b_g, b_a) at the times; `fly`, which goes on to a time with a force.
    """
    config, rng, mount = VioConfig(), np.random.default_rng(seed), load_vehicle("snapdragon").mounts["down"]
    imu, R = config.imu, so3.exp(ATTITUDES[attitude])
    p, sigma = np.array([0.5, 0.2, 1.2]), np.array([0.001] * 3)
    vio = VisualInertialOdometry(config, mount, p + rng.normal(0.0, sigma), 0.0)
    vio._last_pose.pose = replace(vio._last_pose.pose, R_WB=so3.exp([0.0, 0.0, rng.normal(0.0, CONFIGURED_POSE_SIGMA[3])]) @ R)  # as left by a lost filter
    bias = rng.normal(0.0, np.repeat([imu.gyro_bias_init, imu.accel_bias_init], 3))
    walk = np.repeat([imu.gyro_bias_walk, imu.accel_bias_walk], 3) / np.sqrt(rate)
    noise = np.repeat([imu.gyro_noise_density, imu.accel_noise_density], 3) * np.sqrt(rate)
    seen, frame, k = [], 0.1, 0
    image = blank(rng, 3, 1) if dark else blank(rng)

    def fly(until, force=np.zeros(3)):
        nonlocal bias, frame, k
        while k / rate < until:
            k += 1
            bias = bias + walk * rng.normal(size=6)
            read = bias + noise * rng.normal(size=6)
            vio.add_imu(ImuSample(round(1e9 * k / rate), tuple(read[:3]), tuple(read[3:] + R.T @ (force + [0.0, 0.0, 9.81]))))
            if k / rate > frame + 0.05:
                result = vio.add_image(round(frame * 1e9), image(len(seen)))
                seen.append(result.outcome)
                frame += 1 / fps
        s = vio.filter.state
        return np.concatenate([p - s.p_WB, -s.v_WB, so3.log(s.R_WB.T @ R), bias[:3] - s.gyro_bias, bias[3:] - s.accel_bias]), \
            (result.estimate.P if result.estimate else None)

    return vio, seen, [fly(time) for time in times], fly


@pytest.mark.slow
@pytest.mark.parametrize("attitude, dark", [("ground", False), ("wall", True), ("upside down", False), ("upside down", True)])
def test_rest_in_any_attitude_is_known_for_long_and_honestly(attitude, dark):
    """Minutes; what does not grow in these does not grow in an hour."""
    _, outcomes, ((_, before), (error, after)), _ = rest(1, attitude, (30.0, 120.0), dark)
    assert set(outcomes[2:]) == {FrameOutcome.RESTING}
    np.testing.assert_allclose(np.sqrt(np.diag(after))[:9], np.sqrt(np.diag(before))[:9], rtol=0.05)
    assert error @ np.linalg.solve(after, error) < 37.7  # chi2, 15, 99.9 %
    assert np.abs(error[9:12]).max() < 0.002  # the gyro's bias walked by 0.002


@pytest.mark.slow
def test_errors_at_rest_are_as_large_as_the_covariance_says():
    ends = [rest(seed, "wall", (10.0,), True)[2][-1] for seed in range(12)]
    assert 10.0 < np.mean([e @ np.linalg.solve(P, e) for e, P in ends]) < 21.0  # chi2, 15 x 12, 99.9 %, about


@pytest.mark.slow
def test_what_is_said_of_now_holds_while_a_departure_is_not_yet_noticed():
    """A climb that begins as smoothly as in `PerchMotion`, z = 4.6 m/s^5 t^5: when it is noticed, the vehicle has 10 cm/s."""
    rng, out = np.random.default_rng(3), []
    config, mount = VioConfig(), load_vehicle("snapdragon").mounts["down"]
    noise = np.repeat([config.imu.gyro_noise_density, config.imu.accel_noise_density], 3) / np.sqrt(0.002)
    for _ in range(12):
        vio, frame = VisualInertialOdometry(config, mount, rng.normal(0.0, CONFIGURED_POSE_SIGMA[:3])), 0.1 + rng.uniform(0.0, 1 / 30)
        for k in range(650):
            t = 0.002 * k
            read = noise * rng.normal(size=6) + [0, 0, 0, 0, 0, 9.81 + 92.0 * max(t - 0.001 - 1.0, 0.0)**3]  # mean of the period
            vio.add_imu(ImuSample(k * 2 * MS, tuple(read[:3]), tuple(read[3:])))
            if t > frame + 0.02:
                e = vio.add_image(round((frame + mount.stamp_offset) * 1e9), np.full((480, 640), 110, np.uint8)).estimate
                if e is not None and frame > 0.6:
                    gone = max(frame - 1.0, 0.0)
                    error = np.array([4.6 * gone**5 - e.p_WB[2], 23.0 * gone**4 - e.v_WB[2]])
                    out.append((frame, error @ np.linalg.solve(e.P[np.ix_([2, 5], [2, 5])], error)))
                frame += 1 / 30
    times, nees = np.array(out).T
    assert max(nees) < 18.4  # chi2, 2, 1e-4
    for begin, end in ((0.6, 1.0), (1.15, 1.25)):
        assert 1.0 < nees[(times > begin) & (times < end)].mean() < 3.0  # 2 if all is as it says; "at rest" makes it 3.8 at the end


@pytest.mark.slow
def test_a_departure_from_a_wall_in_the_dark_is_noticed():
    vio, outcomes, _, fly = rest(2, "wall", (5.0,), True, fps=30.0)
    fly(5.6, force=np.array([-2.0, 0.0, 0.0]))
    assert outcomes[-1] in (FrameOutcome.LEAVING, FrameOutcome.BLIND)
    dt = vio.filter.state.stamp * 1e-9 - 5.0
    assert vio.filter.state.v_WB[0] == pytest.approx(-2.0 * dt, abs=0.1)
