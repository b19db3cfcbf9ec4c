"""Standing still as VIO sees it before it sees anything: on the ground, after a shake, and when the vehicle has gone for good."""

import numpy as np
import pytest
from perch_core.vehicle import load_vehicle
from perch_perception.ukf import ImuSample
from perch_perception.vio import FrameOutcome, VioConfig, VisualInertialOdometry

MS = 1_000_000


def outcomes(climb, drop, until=2.6):
    """Frames over a blank floor: rest for 1 s, `climb` and `drop` [m/s^2] for 0.1 s each, then nothing more; (time, outcome, height)."""
    rng, mount = np.random.default_rng(1), load_vehicle("snapdragon").mounts["down"]
    vio, out, frame = VisualInertialOdometry(VioConfig(), mount), [], 0.1
    for k in range(round(until / 0.002)):
        t = 0.002 * k
        up = 9.81 + (climb if 1.0 <= t < 1.1 else drop if 1.1 <= t < 1.2 else 0.0)
        vio.add_imu(ImuSample(k * 2 * MS, tuple(rng.normal(0, 0.002, 3)), tuple(rng.normal(0, 0.05, 3) + [0, 0, up])))
        if t > frame + 0.02:
            image = np.clip(rng.normal(110, 4, (480, 640)), 0, 255).astype(np.uint8)
            result = vio.add_image(round(frame * 1e9), image)
            out.append((frame, result.outcome, vio.filter.state.p_WB[2] if vio.filter else 0.0))
            frame += 1 / 30
    return out


def test_a_shake_on_the_ground_is_rest_again():
    seen = outcomes(climb=1.5, drop=-1.5)
    assert all(o is FrameOutcome.RESTING for t, o, _ in seen if 0.5 < t < 1.0)
    assert any(o is not FrameOutcome.RESTING for t, o, _ in seen if 1.0 < t < 1.3)
    assert all(o is FrameOutcome.RESTING for t, o, _ in seen if t > 1.8)


def test_a_steady_climb_is_not_rest():
    """Nothing to see and a quiet IMU, but a velocity that the filter knows: it was told to have stopped, and to be back on the ground."""
    seen = outcomes(climb=3.0, drop=0.0)
    late = [(o, z) for t, o, z in seen if t > 1.5]
    assert not any(o is FrameOutcome.RESTING for o, _ in late)
    assert late[-1][1] == pytest.approx(0.015 + 0.3 * (seen[-1][0] - 1.1), abs=0.05)
