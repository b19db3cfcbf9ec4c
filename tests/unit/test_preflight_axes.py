"""Preflight on the simulated vehicle with deliberately wrong axes: each is refused by name, with exit code 1; the right ones pass."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import cv2
import numpy as np
import pytest
from perch_core.urdf import fixed_frames, optical_frame
from perch_core.values import CameraModel, Transform
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.preflight import checks, command
from perch_eval.camera_turns import CameraTurns
from perch_eval.preflight.ros import listener
from perch_sim.drawing import OnDemandRendering
from perch_sim.parameters import VehicleParameters
from perch_sim.scenario import load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle
from scipy.spatial.transform import Rotation

VEHICLE = load_vehicle("rpg")                      # its front camera is a pinhole
MOUNT = VEHICLE.mounts["front"]
FRAME = 33_000_000                                 # from image to image [ns]
FRAMES = 30
UPSIDE_DOWN, QUARTER = np.diag([1.0, -1.0, -1.0]), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


class Seen(NamedTuple):
    """Of the vehicle with right axes: values by channel at rest, IMU samples while it is shaken, and what the front camera sees then."""

    rest: dict[str, list]
    shaken: list
    spans: list


def rates_B(t: np.ndarray) -> np.ndarray:
    """Of a vehicle that is shaken by hand [rad/s], (n, 3): by 10 to 15 deg about all axes."""
    return np.stack([1.4 * np.sin(6.0 * t), 1.2 * np.sin(7.5 * t + 1.0), 1.0 * np.sin(5.0 * t + 2.0)], axis=1)


@pytest.fixture(scope="module")
def seen() -> Seen:
    scenario = replace(load_scenario("surface_90"), vehicle="rpg")
    vehicle = SimulatedVehicle(VehicleParameters(seed=3, cameras="none"), scenario, OnDemandRendering)
    imu: list = []
    odometry: list = []
    vehicle.imu.receivers.append(imu.append)
    vehicle.truth.receivers.append(odometry.append)
    for _ in range(500):
        vehicle.advance()
    vehicle.close()
    end = imu[-1].stamp
    rest = {"imu/data_raw": imu[100:], "odometry": odometry[100:], "/tf_static": list(fixed_frames(VEHICLE))}
    rest |= {f"camera_{name}/camera_info": [CameraModel(end - k * FRAME, optical_frame(name), mount.camera) for k in range(20, 0, -1)]
             for name, mount in VEHICLE.mounts.items()}

    t = 0.002 * np.arange(1, round(FRAMES * FRAME * 0.5e-6))
    w = rates_B(t)
    shaken = [imu[-1]._replace(stamp=end + round(1e9 * time), w_B=tuple(rate)) for time, rate in zip(t, w)]
    R_BB, at = [Rotation.identity()], [0.0]                    # of the body now in that of the beginning
    for time, rate in zip(t, w):
        R_BB.append(R_BB[-1] * Rotation.from_rotvec(0.002 * rate))
        at.append(time)
    camera, R_BC, turns = MOUNT.camera, Rotation.from_matrix(MOUNT.R_BC), CameraTurns(MOUNT.camera)
    picture = cv2.GaussianBlur(np.random.default_rng(3).integers(0, 256, (camera.height, camera.width)).astype(np.uint8), (0, 0), 4.0)
    picture = cv2.normalize(picture, None, 0, 255, cv2.NORM_MINMAX)
    for k in range(FRAMES):
        exposed = 1e-9 * k * FRAME
        R = (R_BC.inv() * R_BB[int(np.searchsorted(at, exposed))] * R_BC).as_matrix()  # of a texture at infinity: K R^T K^-1
        turns.add(end + k * FRAME + round(1e9 * MOUNT.stamp_offset), cv2.warpPerspective(
            picture, camera.K @ R.T @ np.linalg.inv(camera.K), (camera.width, camera.height), borderMode=cv2.BORDER_REFLECT))
    return Seen(rest, shaken, turns.spans)


def refused(seen: Seen, monkeypatch, capsys, axes: np.ndarray = np.eye(3), file: Vehicle = VEHICLE,
            more: tuple[str, ...] = ()) -> tuple[int, list[str]]:
    """Exit code of preflight, and the names of what has failed.

    Args:
        axes: of the IMU, its readings are `axes` of the true ones.
        file: what the vehicle file says.
        more: arguments.
    """
    def read(samples: list) -> list:
        return [one._replace(f_B=tuple(axes @ one.f_B), w_B=tuple(axes @ one.w_B)) for one in samples]

    class Bench(listener.GraphListener):
        """In the place of the graph: everything is there at once."""

        def __init__(self, vehicle: Vehicle, namespace: str = "", cameras: Iterable[str] = ()) -> None:
            values = {**seen.rest, "imu/data_raw": read(seen.rest["imu/data_raw"])}
            self.values = {channel: [(1e-9 * getattr(value, "stamp", 0), value) for value in values.get(channel, [])]
                           for channel in (*listener.CHANNELS, *(f"camera_{name}/camera_info" for name in cameras))}
            self.turns = CameraTurns(MOUNT.camera)

        def subscribe_camera(self, camera, model) -> None:
            self.turns.spans = seen.spans
            self.values["imu/data_raw"] += [(1e-9 * one.stamp, one) for one in read(seen.shaken)]

        def spin_for(self, duration: float) -> None:
            pass

        def await_first(self, channel: str, timeout: float) -> None:
            pass

        def close(self) -> None:
            pass

    monkeypatch.setattr(listener, "GraphListener", Bench)
    monkeypatch.setattr(command, "load_vehicle", lambda name: file)
    monkeypatch.setattr("sys.argv", ["preflight.py", "--vehicle", "rpg", "--shake", "front", *more])
    code, lines = command.main(), capsys.readouterr().out.splitlines()
    failed = [number for number, line in enumerate(lines) if line.startswith("FAILED")]
    assert all(lines[number + 1].lstrip().startswith("-> ") for number in failed), "each says what to do"
    assert f"{len(failed)} FAILED" in lines[-1]
    return code, [lines[number][15:43].strip() for number in failed]


def mounted(R_BC: np.ndarray) -> Vehicle:
    """The file with another orientation of the front camera."""
    front = replace(VEHICLE.cameras["front"], orientation=tuple(Rotation.from_matrix(R_BC).as_quat()))
    return replace(VEHICLE, cameras={**VEHICLE.cameras, "front": front})


def test_right_axes_pass(seen, monkeypatch, capsys):
    assert refused(seen, monkeypatch, capsys) == (0, [])


TITLE = "rotation camera_front to IMU"


@pytest.mark.parametrize("axes, names", [
    (UPSIDE_DOWN, ["gravity up", TITLE]),                               # FRD, or gravity down
    (-np.eye(3), ["gravity up", TITLE]),                                # gravity instead of specific force, rates of the world in the body
    (QUARTER, [TITLE]), (QUARTER @ QUARTER, [TITLE]),                   # the board turned about z
    (QUARTER @ UPSIDE_DOWN, ["gravity up", TITLE]),
    (np.diag([-1.0, 1.0, 1.0]), [TITLE]), (np.diag([1.0, -1.0, 1.0]), [TITLE])])
def test_axes_of_the_imu_that_are_wrong_are_refused(seen, monkeypatch, capsys, axes, names):
    assert refused(seen, monkeypatch, capsys, axes=axes) == (1, names)


@pytest.mark.parametrize("axis", range(3))
def test_a_rate_of_the_wrong_sign_is_refused_though_gravity_is_right(seen, monkeypatch, capsys, axis):
    sign = np.ones(3)
    sign[axis] = -1.0
    wrong = seen._replace(shaken=[one._replace(w_B=tuple(sign * one.w_B)) for one in seen.shaken])
    assert refused(wrong, monkeypatch, capsys) == (1, [TITLE])


@pytest.mark.parametrize("axis", range(3))
def test_a_wrong_sign_is_seen_about_the_axis_that_is_turned_about_least(axis):
    """The rotation that fits best is that of the file then."""
    rates, sign = np.random.default_rng(axis).standard_normal((60, 3)), np.ones(3)
    rates[:, axis] *= 0.5
    sign[axis] = -1.0
    check = checks.check_rotation("front", rates * sign, rates @ MOUNT.R_BC, VEHICLE)
    assert check.verdict is checks.Verdict.FAILED and "left-handed" in check.observation
    rates[:, axis] *= 0.4
    assert checks.check_rotation("front", rates * sign, rates @ MOUNT.R_BC, VEHICLE).verdict is checks.Verdict.OPEN, "not turned about enough"


@pytest.mark.parametrize("by", ["frame", "file"])
def test_an_imu_in_other_axes_passes_where_the_nodes_turn_it(seen, monkeypatch, capsys, tmp_path, by):
    """Forward, right, down, placed by `/tf_static` or by the sensor file."""
    def turned(samples, frame):
        return [s._replace(w_B=tuple(UPSIDE_DOWN @ s.w_B), f_B=tuple(UPSIDE_DOWN @ s.f_B), frame=frame) for s in samples]

    frame = "fcu" if by == "frame" else "imu_link"
    rest = {**seen.rest, "imu/data_raw": turned(seen.rest["imu/data_raw"], frame)}
    more: tuple[str, ...] = ()
    if by == "frame":
        rest["/tf_static"] = [*rest["/tf_static"], Transform("base_link", "fcu", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))]
    else:
        file = tmp_path / "mine.yaml"
        file.write_text("name: mine\nimu: {rate: 500, accel_noise_density: 0.01, gyro_noise_density: 0.001, accel_bias_walk: 0.001,\n"
                        "  gyro_bias_walk: 0.0001, orientation: [1.0, 0.0, 0.0, 0.0]}\n")
        more = ("--sensors", str(file))
    flipped = seen._replace(rest=rest, shaken=turned(seen.shaken, frame))
    assert refused(flipped, monkeypatch, capsys, more=more) == (0, [])
    assert refused(seen._replace(rest={**rest, "/tf_static": seen.rest["/tf_static"]}), monkeypatch, capsys)[0] == 1


@pytest.mark.parametrize("turn", [(0, 0, 180), (0, 0, 10), (90, 0, 0), (0, 6, 0)])
def test_extrinsics_of_the_file_that_are_wrong_are_refused(seen, monkeypatch, capsys, turn):
    """What the graph publishes and what shaking shows both speak against the file."""
    wrong = mounted(MOUNT.R_BC @ Rotation.from_euler("xyz", turn, degrees=True).as_matrix())
    assert refused(seen, monkeypatch, capsys, file=wrong) == (1, ["extrinsics camera_front_opti", TITLE])


def test_extrinsics_that_graph_and_file_have_wrong_are_refused_by_shaking(seen, monkeypatch, capsys):
    wrong = mounted(MOUNT.R_BC @ np.diag([-1.0, -1.0, 1.0]))  # upside down
    same = seen._replace(rest={**seen.rest, "/tf_static": list(fixed_frames(wrong))})
    assert refused(same, monkeypatch, capsys, file=wrong) == (1, [TITLE])
