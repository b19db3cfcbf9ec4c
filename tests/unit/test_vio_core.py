"""The MSCKF's parts against independent forms: finite differences, exact motion, projection, linear algebra."""

import dataclasses

import numpy as np
import pytest
from perch_core import so3
from perch_core.camera import PinholeCamera, RadialTangentialCamera
from perch_core.vehicle import GRAVITY, load_vehicle
from open_loop.motion import PerchMotion
from perch_core.values import ImuSample
from perch_perception.ukf.imu_buffer import ImuBuffer
from perch_perception.vio import VioConfig, bearing, ekf, lens
from perch_perception.vio.bearing import observe, residuals
from perch_perception.vio.gyro_bias import RayPair, solve_gyro_bias
from perch_perception.vio.landmark_choice import Spread, cell
from perch_perception.vio.motion_start import solve_motion
from perch_perception.vio.preintegration import preintegrate
from perch_perception.vio.tracks import Tracks
from perch_perception.vio.triangulation import triangulate

MOUNT = load_vehicle("snapdragon").mounts["down"]
STEP = 1e-6


def scene(rng, n=6):
    """n body poses and points below them."""
    R = so3.exp(0.2 * rng.normal(size=(n, 3)))
    p = 0.1 * rng.normal(size=(n, 3))
    X = np.column_stack([0.8 * rng.normal(size=(n, 2)), np.full(n, -1.0)])
    return R, p, X


def in_camera(R, p, X, R_BC=MOUNT.R_BC, p_BC=MOUNT.p_BC):
    return (np.einsum("nji,nj->ni", R, X - p) - p_BC) @ R_BC


# -- bearings ------------------------------------------------------------------------------------------------------------


def test_bearings_are_those_of_the_camera():
    rng = np.random.default_rng(9)
    camera = dataclasses.replace(MOUNT.camera, angle_limit=1.3)
    pixels = np.vstack([[[camera.cx, camera.cy]], rng.uniform(0, [camera.width, camera.height], (300, 2))])
    rays, expected = lens.observe(camera, pixels)[0], camera.unproject(pixels)
    assert np.isnan(expected).any() and np.isfinite(expected).any()
    np.testing.assert_allclose(rays, expected, atol=1e-12)


def test_residual_jacobians_are_those_of_finite_differences():
    rng = np.random.default_rng(1)
    R, p, X = scene(rng)
    pixels, valid = MOUNT.camera.project(in_camera(R, p, X))
    assert valid.all()
    measured = observe(MOUNT.camera, pixels + rng.normal(0, 3.0, pixels.shape))

    def r(R=R, p=p, X=X, R_BC=MOUNT.R_BC, p_BC=MOUNT.p_BC):
        return residuals(R, p, X, R_BC, p_BC, measured).r

    linear = residuals(R, p, X, MOUNT.R_BC, MOUNT.p_BC, measured)
    cases = {
        "THETA": lambda d: r(R=R @ so3.exp(d)), "POSITION": lambda d: r(p=p + d), "POINT": lambda d: r(X=X + d),
        "CAMERA_ROTATION": lambda d: r(R_BC=MOUNT.R_BC @ so3.exp(d)), "CAMERA_POSITION": lambda d: r(p_BC=MOUNT.p_BC + d)}
    for name, moved in cases.items():
        # r = H x for an error x of the state: moving the estimate by d leaves the error -d
        numeric = np.stack([-(moved(STEP * e) - moved(-STEP * e)) / (2 * STEP) for e in np.eye(3)], axis=-1)
        np.testing.assert_allclose(linear.J[:, :, getattr(bearing, name)], numeric, atol=1e-7, err_msg=name)


@pytest.mark.parametrize("camera", [
    MOUNT.camera, PinholeCamera(640, 480, 275.0, 275.0, 320.0, 240.0),
    RadialTangentialCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (-0.1, 0.01, 0.0, 0.0, 0.0)),
    RadialTangentialCamera(640, 480, 275.0, 275.0, 320.0, 240.0, (0.4, 0.1, 0.0, 0.0, 0.01, 0.6, 0.2, 0.02))])
@pytest.mark.parametrize("column, name", list(enumerate(("fx", "fy", "cx", "cy"))))
def test_the_lens_derivatives_are_those_of_another_lens(camera, column, name):
    rng = np.random.default_rng(2)
    R, p, X = scene(rng)
    error = 1e-4  # relative, or in focal lengths
    value = {"fx": 275.0 * np.exp(error), "fy": 275.0 * np.exp(error), "cx": camera.cx + 275.0 * error, "cy": camera.cy + 275.0 * error}[name]
    measured = observe(camera, dataclasses.replace(camera, **{name: value}).project(in_camera(R, p, X))[0])
    linear = residuals(R, p, X, MOUNT.R_BC, MOUNT.p_BC, measured)
    assert np.abs(linear.r).max() > 3e-5
    np.testing.assert_allclose(linear.r, linear.J[:, :, bearing.LENS.start + column] * error, atol=2e-7)


def test_the_lens_derivatives_do_not_follow_the_noise():
    """They are those of the prediction: with the residual's own noise in them every observation would teach a longer lens."""
    rng = np.random.default_rng(3)
    R, p, X = scene(rng)
    pixels = MOUNT.camera.project(in_camera(R, p, X))[0]
    sizes = [np.linalg.norm(residuals(R, p, X, MOUNT.R_BC, MOUNT.p_BC, observe(MOUNT.camera, centre + scale * (pixels - centre)))
                            .J[:, :, bearing.LENS].sum(axis=2, where=[True, True, False, False]), axis=1)
             for centre in [np.array([MOUNT.camera.cx, MOUNT.camera.cy])] for scale in (1.0, 0.99)]
    inner = sizes[0] < 1.2  # towards its rim the lens's slope changes, too
    assert inner.sum() > 2
    np.testing.assert_allclose(sizes[1][inner], sizes[0][inner], rtol=1e-3)  # by 1e-2 at the measurement


# -- preintegration ------------------------------------------------------------------------------------------------------


def flip_rows(gyro_shift=0.0, accel_shift=0.0):
    """IMU steps through the fastest 60 ms of a perch, exact but for shifts."""
    motion = PerchMotion()
    times = np.arange(motion.duration - 0.12, motion.duration - 0.05, 0.002)
    m = motion.sample(times)
    w, f = 0.5 * (m.w_WB_B[1:] + m.w_WB_B[:-1]), 0.5 * (m.f_B[1:] + m.f_B[:-1])
    n = len(w)
    return m, np.column_stack([np.full(n, 0.002), w + gyro_shift, f + accel_shift, np.full(n, 1e-4), np.full(n, 0.1)])


def test_preintegration_gives_the_exact_motion():
    m, rows = flip_rows()
    pre = preintegrate(rows, np.zeros(3), np.zeros(3))
    g, T = np.array([0, 0, -GRAVITY]), pre.duration
    np.testing.assert_allclose(m.R_WB[0] @ pre.dR, m.R_WB[-1], atol=2e-4)
    np.testing.assert_allclose(m.v_WB[0] + g * T + m.R_WB[0] @ pre.dv, m.v_WB[-1], atol=1e-3)
    np.testing.assert_allclose(m.p_WB[0] + m.v_WB[0] * T + 0.5 * g * T**2 + m.R_WB[0] @ pre.dp, m.p_WB[-1], atol=1e-4)
    np.testing.assert_allclose(pre.w_end, rows[-1, 1:4])


def test_preintegration_bias_jacobian_is_that_of_finite_differences():
    _, rows = flip_rows()
    base = preintegrate(rows, np.zeros(3), np.zeros(3))
    h = 1e-4
    for i in range(6):
        d = np.zeros(6)
        d[i] = h
        a, b = preintegrate(rows, d[:3], d[3:]), preintegrate(rows, -d[:3], -d[3:])
        numeric = np.concatenate([so3.log(base.dR.T @ a.dR) - so3.log(base.dR.T @ b.dR), a.dp - b.dp, a.dv - b.dv]) / (2 * h)
        np.testing.assert_allclose(base.J[:, i], numeric, rtol=2e-3, atol=2e-6)


@pytest.mark.parametrize("count", [1, 35])
def test_preintegration_noise_is_that_of_its_readings_by_finite_differences(count):
    rows, h = flip_rows()[1][:count], 1e-4
    base, expected = preintegrate(rows, np.zeros(3), np.zeros(3)), np.zeros((9, 9))
    for k, column in np.ndindex(count, 6):
        ends = []
        for step in (h, -h):
            read = rows.copy()
            read[k, 1 + column] += step
            pre = preintegrate(read, np.zeros(3), np.zeros(3))
            ends.append(np.concatenate([so3.log(base.dR.T @ pre.dR), pre.dp, pre.dv]))
        by_reading = (ends[0] - ends[1]) / (2 * h)
        expected += rows[k, 7 if column < 3 else 8] * np.outer(by_reading, by_reading)
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(base.Q / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), atol=0.01)


# -- triangulation and updates -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cut", [1, 3_000_000, 4_999_999])
def test_parts_of_a_sample_gather_the_noise_of_the_whole(cut):
    """A sample that a frame cuts in two has one error: what both runs gather is what one run over it does."""
    config = VioConfig()
    buffer = ImuBuffer(config.imu, 1.0)
    for k in range(11):
        buffer.add(ImuSample(10_000_000 * k, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))

    def gathered(begin, end):
        Q = preintegrate(buffer.run(begin, end, sensor_noise=True), np.zeros(3), np.zeros(3)).Q
        return np.diag(Q)[[0, 6]]

    density2 = np.array([config.imu.gyro_noise_density, config.imu.accel_noise_density]) ** 2
    middle = 50_000_000 + cut
    first, second = gathered(0, middle), gathered(middle, 100_000_000)
    np.testing.assert_allclose(first, density2 * middle * 1e-9, rtol=1e-6)
    np.testing.assert_allclose(first + second, gathered(0, 100_000_000), rtol=1e-6)
    np.testing.assert_allclose(gathered(52_000_000, 55_000_000), density2 * 0.003, rtol=1e-6)


def test_triangulation_finds_the_point_and_refuses_what_tells_nothing():
    rng = np.random.default_rng(4)
    X, centres = np.array([0.4, -0.2, 0.0]), np.column_stack([np.linspace(0, 0.3, 6), np.zeros(6), np.full(6, 1.2)])
    rays = X - centres
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    np.testing.assert_allclose(triangulate(centres, rays, np.radians(2), 1e-3), X, atol=1e-6)
    noisy = rays + rng.normal(0, 1e-3, rays.shape)
    noisy /= np.linalg.norm(noisy, axis=1, keepdims=True)
    assert np.linalg.norm(triangulate(centres, noisy, np.radians(2), 1e-3) - X) < 0.02
    assert triangulate(centres, rays, np.radians(20), 1e-3) is None       # too little parallax
    assert triangulate(centres, -rays, np.radians(2), 1e-3) is None       # behind the camera
    rays[2] = [0.0, 0.7, -np.sqrt(1 - 0.49)]
    assert triangulate(centres, rays, np.radians(2), 1e-3) is None        # one ray elsewhere


def test_elimination_and_compression_keep_the_information():
    rng = np.random.default_rng(5)
    H, H_f, r = rng.normal(size=(20, 9)), rng.normal(size=(20, 3)), rng.normal(size=20)
    R_f, H_1, r_1, H_0, r_0 = ekf.eliminate(H, H_f, r)
    # marginal information about x after the point is eliminated (Schur complement), by two ways
    full = np.hstack([H, H_f])
    I = full.T @ full
    schur = I[:9, :9] - I[:9, 9:] @ np.linalg.inv(I[9:, 9:]) @ I[9:, :9]
    np.testing.assert_allclose(H_0.T @ H_0, schur, atol=1e-10)
    H_c, r_c = ekf.compress(H_0, r_0)
    assert H_c.shape == (9, 9)
    np.testing.assert_allclose(H_c.T @ H_c, schur, atol=1e-10)
    np.testing.assert_allclose(H_c.T @ r_c, H_0.T @ r_0, atol=1e-10)
    assert R_f.shape == (3, 3) and H_1.shape == (3, 9) and r_1.shape == (3,)


def test_update_is_the_information_form():
    rng = np.random.default_rng(6)
    A = rng.normal(size=(8, 8))
    P, columns, H, r = A @ A.T + np.eye(8), np.array([1, 4, 6]), rng.normal(size=(5, 3)), rng.normal(size=5)
    full = np.zeros((5, 8))
    full[:, columns] = H
    dx, P_new, _ = ekf.update(P, columns, H, r, 0.3)
    expected = np.linalg.inv(np.linalg.inv(P) + full.T @ full / 0.3)
    np.testing.assert_allclose(P_new, expected, atol=1e-9)
    np.testing.assert_allclose(dx, expected @ full.T @ r / 0.3, atol=1e-9)


def test_landmarks_are_spread_over_the_view():
    near = {i: np.array([0.01 * i, 0.0, 1.0]) for i in range(8)}
    spread = Spread(near, 8)
    assert not spread.admits(np.array([0.02, 0.01, 1.0]))  # its cell is full
    far = np.array([1.0, 0.3, 1.0])
    assert cell(far) != cell(near[0]) and spread.admits(far)
    assert spread.add(99, far) == 7  # the newest of the crowd goes
    assert Spread({}, 8).add(1, far) is None


# -- start in motion -----------------------------------------------------------------------------------------------------


def start_in_motion(seed, accel_bias=np.zeros(3)):
    """Half a second of a climb as `solve_motion` takes it, with rays that are 1 mrad wrong; and the velocity and up in B0."""
    motion, rng, T = PerchMotion(seed=seed), np.random.default_rng(seed), np.arange(15) / 30
    m, g = motion.sample(1.9 + T), np.array([0.0, 0.0, -GRAVITY])
    R0 = m.R_WB[0]
    dR, by_bias = R0.T @ m.R_WB, -0.5 * T[:, None, None] ** 2 * np.eye(3)  # of a body that hardly turns
    dp = (m.p_WB - m.p_WB[0] - m.v_WB[0] * T[:, None] - 0.5 * g * T[:, None] ** 2) @ R0 - by_bias @ accel_bias
    dv = R0.T @ (m.v_WB[-1] - m.v_WB[0] - g * T[-1]) + accel_bias * T[-1]
    centres, X = dR @ MOUNT.p_BC, np.column_stack([rng.uniform(-1, 1, (40, 2)), np.zeros(40)])
    rays = (X[:, None] - m.p_WB) @ R0 - centres
    rays += 1e-3 * np.linalg.norm(rays, axis=2, keepdims=True) * rng.normal(size=rays.shape)
    rays /= np.linalg.norm(rays, axis=2, keepdims=True)
    return (T, dp, dv, by_bias, centres, rays, np.ones((40, 15), bool), 1e-3), R0.T @ m.v_WB[0], -R0.T @ g


@pytest.mark.parametrize("seed", [6, 7, 8])
@pytest.mark.parametrize("bias", [0.0, 1.0])
def test_velocity_and_gravity_from_half_a_second_of_motion(seed, bias):
    """With an accelerometer that is 1 m/s^2 wrong, too, if that is what its data sheet allows: as well as the covariance says."""
    given, v, up = start_in_motion(seed, np.array([0.6, -0.5, 0.6]) * bias)
    found = solve_motion(*given, 0.05 if bias == 0.0 else 1.0)[0]
    assert np.linalg.norm(found.g) == pytest.approx(GRAVITY) and found.residual < 2e-3
    error = found.v - v
    assert error @ np.linalg.solve(found.covariance[:3, :3], error) < 16.3  # chi2, 3, 99.9 %
    if bias == 0.0:
        assert np.linalg.norm(error) < 0.08
        assert np.degrees(so3.angle_between(-found.g, up)) < 1.0


def test_a_vehicle_that_stands_still_tells_no_scale():
    rays = np.array([np.tile([0.1 * k, 0.2, -1.0] / np.linalg.norm([0.1 * k, 0.2, -1.0]), (15, 1)) for k in range(20)])
    T, up = np.arange(15) / 30, np.array([0.0, 0.0, 1.0])
    assert solve_motion(T, 0.5 * GRAVITY * np.outer(T**2, up), GRAVITY * T[-1] * up, np.zeros((15, 3, 3)), np.zeros((15, 3)), rays,
                        np.ones((20, 15), bool), 1e-3, 0.05) == []


def test_an_imu_that_reads_zero_is_no_error_of_the_motion_start():
    (T, dp, dv, by_bias, centres, rays, seen, sigma), _, _ = start_in_motion(6, np.zeros(3))
    assert all(np.isfinite(found.v).all() for found in solve_motion(T, 0.0 * dp, 0.0 * dv, by_bias, centres, rays, seen, sigma, 0.05))


@pytest.mark.parametrize("moving", [0.0, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_the_gyro_bias_is_found_in_motion(seed, moving):
    """0.2 rad/s in any direction, from a view that moves, or only turns; a tenth or more of the tracks goes its own way."""
    rng = np.random.default_rng(seed)
    direction = rng.normal(size=3)
    bias, sigma, pairs = 0.2 * direction / np.linalg.norm(direction), 1e-3, []
    for k in range(7):
        X = rng.uniform([-2.0, -2.0, 1.0], [2.0, 2.0, 4.0], (60, 3))
        R, t, dt = so3.exp(rng.normal(0.0, 0.1, 3)), moving * rng.normal(0.0, 0.1, 3), 0.25
        first, second = X + rng.normal(0.0, sigma, X.shape) * X[:, 2:], (X - t) @ R + rng.normal(0.0, sigma, X.shape) * X[:, 2:]
        second[:6] += rng.normal(0.0, 0.5, (6, 3))
        read = R @ so3.exp(bias * dt)  # what the gyro says; a bias that is taken off turns it back
        pairs.append(RayPair(read, -dt * np.eye(3), *((v / np.linalg.norm(v, axis=1, keepdims=True))[:60 - 3 * k] for v in (first, second))))
    found, P = solve_gyro_bias(pairs, sigma, 0.1)
    assert np.linalg.norm(found - bias) < 0.012
    assert np.sqrt(np.linalg.eigvalsh(P)[-1]) < 0.005


# -- bookkeeping ---------------------------------------------------------------------------------------------------------


def test_tracks_end_and_forget():
    tracks = Tracks()
    camera = MOUNT.camera
    for frame in range(5):
        ids = np.array([1, 2]) if frame < 3 else np.array([2, 3])
        ended = tracks.take_ended(ids)
        assert list(ended) == ([1] if frame == 3 else [])
        tracks.observe(frame, ids, observe(camera, np.full((2, 2), 300.0)))
    tracks.forget_before(2)
    assert tracks.by_id[2].frames == [2, 3, 4] and len(tracks.by_id[2].b_C) == 3
