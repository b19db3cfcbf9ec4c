"""Checks of the data that a graph published in a few seconds. Each has a verdict, the observation, and advice."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum
from math import acos, degrees

import numpy as np

from perch_control.modes import State
from perch_core import so3
from perch_core.camera import Camera
from perch_core.sensors import Sensors
from perch_core.urdf import fixed_frames, optical_frame
from perch_core.values import CameraModel, ControllerStatus, ImuSample, OdometryState, Transform, seconds
from perch_core.vehicle import GRAVITY, Vehicle
from perch_eval.consistency import attitude_error

MAX_TILT = 10.0          # of a vehicle that stands on its feet [deg]
MAX_FORCE_ERROR = 0.5    # of the mean specific force from gravity [m/s^2]
MAX_REST_RATE = 0.1      # mean body rate at rest [rad/s]
MAX_GAP = 5.0            # periods between two stamps
MAX_DELAY = 0.25         # of camera frames behind IMU samples of the same stamp [s]
MAX_PIXEL_ERROR = 3.0    # by which a point may lie elsewhere in the image than by the file's camera [px]
MAX_EXTRINSICS_ERROR = (0.02, 3.0)  # of a transform from the file [m, deg]
MAX_ROTATION_ERROR = 5.0  # of the rotation from camera to IMU from the file [deg]
MAX_SCALE_ERROR = 0.1    # share by which the gyroscope's rates may be larger or smaller than the camera's
MAX_RESIDUAL = 0.4       # share of the gyroscope's rates that the camera's may leave unexplained
MIN_ROTATION_RATE = 0.3  # root mean square of the rates about each axis that shaking needs [rad/s]
RESPONSE_TIME = 2.0      # from a command to its effect, observed by a program that shares the machine with others [s]
STOP_TIME = 1.0          # from the last command to the motors' stop [s] ...
DESCENT_TIME = 5.0       # ... and where an autopilot levels and descends first [s]
RATES = {"imu/data_raw": (100.0, 1000.0), "odometry": (50.0, 1000.0), "camera_down/camera_info": (10.0, 120.0)}
"""Channel -> (lowest, highest) rate of its stamps [Hz], with a tolerance of 10 %; 10 Hz are for VIO, whose camera is taken to be `down`."""
CAMERA_RATES = (5.0, 120.0)  # of a camera of any other name, also where VIO uses it [Hz]
_STATES = {state.value: state.name.lower() for state in State}


class Verdict(Enum):
    """Verdict of a check."""

    PASSED = "passed"
    FAILED = "FAILED"
    OPEN = "not exercised"


@dataclass(frozen=True)
class Check:
    """One line of the table: name of the check, verdict, observation, and advice if the check has not passed."""

    name: str
    verdict: Verdict
    observation: str
    advice: str = ""

    def __str__(self) -> str:
        what_to_do = f"\n{'':15s}-> {self.advice}" if self.advice and self.verdict is not Verdict.PASSED else ""
        return f"{self.verdict.value:14s} {self.name:28s} {self.observation}{what_to_do}"


def make_check(name: str, good: bool, observation: str, advice: str) -> Check:
    """Return a check that has passed or failed."""
    return Check(name, Verdict.PASSED if good else Verdict.FAILED, observation, advice)


def check_stream(channel: str, stamps: Sequence[int], silence: Verdict = Verdict.FAILED) -> list[Check]:
    """Check the rate of a channel, and whether its stamps [ns] grow evenly; `silence` is the verdict if nothing came."""
    low, high = RATES.get(channel, CAMERA_RATES)
    if len(stamps) < 3:
        advice = "start its publisher; check namespaces, ROS_DOMAIN_ID and QoS (topic.py info)"
        return [Check(f"rate {channel}", Verdict.FAILED if stamps else silence, f"{len(stamps)} messages",
                      advice if stamps or silence is Verdict.FAILED else f"where it is needed, {advice}")]
    gaps: np.ndarray = 1e-9 * np.diff(np.array(stamps, dtype=np.int64))
    period = float(np.median(gaps))
    rate = 1.0 / period if period > 0.0 else np.inf
    return [make_check(f"rate {channel}", 0.9 * low <= rate <= 1.1 * high, f"{rate:.4g} Hz",
                       f"{low:g} to {high:g} Hz are needed: set the driver's rate"),
            make_check(f"stamps {channel}", bool((gaps > 0.0).all() and gaps.max() <= MAX_GAP * period),
                       f"steps of {1e3 * gaps.min():.3g} to {1e3 * gaps.max():.3g} ms",
                       "stamps must grow by a period each: stamp at the sensor, not at arrival; look for lost messages")]


def check_at_rest(samples: Sequence[ImuSample]) -> list[Check]:
    """Check specific force and body rates of a vehicle that stands still on its feet."""
    if len(samples) < 50:
        return [Check("gravity up", Verdict.FAILED, "no IMU", "see rate imu/data_raw")]
    f, w = (np.mean([getattr(s, name) for s in samples], axis=0) for name in ("f_B", "w_B"))
    size = float(np.linalg.norm(f))
    tilt = degrees(acos(np.clip(f[2] / max(size, 1e-9), -1.0, 1.0)))
    axis = int(np.argmax(np.abs(f)))
    return [make_check("gravity up", tilt < MAX_TILT, f"specific force [{f[0]:.2f}, {f[1]:.2f}, {f[2]:.2f}] m/s^2, {tilt:.1f} deg from +z",
                       f"it must read +9.8 along z of base_link (forward-left-up), not along {'-' if f[axis] < 0 else '+'}{'xyz'[axis]}: "
                       "stand the vehicle level, or turn the IMU's axes in its driver"),
            make_check("gravity's size", abs(size - GRAVITY) < MAX_FORCE_ERROR, f"{size:.2f} m/s^2",
                       "the accelerometer's unit or scale is wrong (m/s^2, not g or counts)"),
            make_check("gyroscope at rest", float(np.linalg.norm(w)) < MAX_REST_RATE, f"{np.linalg.norm(w):.3f} rad/s",
                       "keep it still and calibrate the gyroscope; rates are rad/s, not deg/s")]


def check_clocks(imu: Sequence[tuple[float, int]], frames: Mapping[str, Sequence[tuple[float, int]]]) -> list[Check]:
    """Check whether cameras and IMU share a clock, from (arrival [s], stamp [ns]) of IMU samples and of each camera's frames.

    The shortest latency from stamp to arrival counts, as delays of this program only increase it.
    """
    def shortest(arrivals: Sequence[tuple[float, int]]) -> float:
        return min(arrival - seconds(stamp) for arrival, stamp in arrivals)

    found = []
    for camera, arrivals in frames.items():
        if imu and arrivals:
            late = shortest(arrivals) - shortest(imu)
            found.append(make_check(f"clock camera_{camera}", -0.02 < late < MAX_DELAY,
                                    f"frames arrive {1e3 * late:.1f} ms after their stamp, by the IMU's clock",
                                    f"0 to {1e3 * MAX_DELAY:.0f} ms are plausible: camera and IMU need one clock, and stamps of the exposure"))
    return found


def without_camera_info(cameras: Vehicle | Sensors) -> Verdict:
    """Return the verdict where no `camera_info` comes: nodes do not use it for the cameras of a sensor file."""
    return Verdict.OPEN if isinstance(cameras, Sensors) else Verdict.FAILED


def check_camera_model(name: str, model: CameraModel | None, cameras: Vehicle | Sensors) -> Check:
    """Check a camera's intrinsics against the vehicle or sensor file; its frame, too, which a sensor file leaves open."""
    title = f"camera_{name} model"
    if model is None:
        return Check(title, without_camera_info(cameras), "no camera_info", f"see rate camera_{name}/camera_info")
    received, expected = model.camera, cameras.mounts[name].camera
    frame = None if isinstance(cameras, Sensors) else optical_frame(name)
    u, v = np.meshgrid(np.linspace(0.0, expected.width - 1.0, 5), np.linspace(0.0, expected.height - 1.0, 5))
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    rays = expected.unproject(pixels)
    known = np.isfinite(rays).all(axis=1)  # others lie beyond a fisheye's circle
    apart = np.linalg.norm(received.project(rays[known])[0] - pixels[known], axis=1)
    off = float(np.nan_to_num(apart, nan=np.inf).max())
    wrong = [what for what, good in (("image size", (received.width, received.height) == (expected.width, expected.height)),
                                     ("lens", off < MAX_PIXEL_ERROR), ("frame", frame in (None, model.frame))) if not good]
    return make_check(title, not wrong, f"{_camera(received)}, frame {model.frame}: points lie up to {off:.1f} px from where the file has them",
                      f"{' and '.join(wrong)} differ{'s' * (len(wrong) == 1)}: {cameras.name} has {_camera(expected)}"
                      f"{'' if frame is None else f', frame {frame}'}: calibrate, or use the right file")


def _camera(camera: Camera) -> str:
    return (f"{camera.width} x {camera.height} px, {camera.model}, f {camera.fx:.1f}, {camera.fy:.1f} px, "
            f"centre {camera.cx:.1f}, {camera.cy:.1f} px, distortion {np.round(camera.distortion, 4).tolist()}")


def check_extrinsics(transforms: Sequence[Transform], vehicle: Vehicle, cameras: Vehicle | Sensors) -> list[Check]:
    """Check the fixed transforms of the graph against the vehicle file, and those of the cameras against the file that describes them.

    `description` publishes the cameras of the vehicle file: a difference from a sensor file is no failure.
    """
    found, replaced = [], [optical_frame(name) for name in cameras.mounts] if isinstance(cameras, Sensors) else []
    for expected in fixed_frames(vehicle, cameras.mounts):
        received = next((t for t in transforms if t.child == expected.child), None)
        if received is None:
            found.append(Check(f"extrinsics {expected.child}", Verdict.OPEN, "not published",
                               f"acceptable where the nodes take it from their file{'' if expected.child in replaced else '; else start `description`'}"))
            continue
        apart = float(np.linalg.norm(np.subtract(received.p, expected.p)))
        turn = degrees(float(np.linalg.norm(attitude_error(np.array(expected.q), np.array(received.q)))))
        good = received.parent == expected.parent and apart < MAX_EXTRINSICS_ERROR[0] and turn < MAX_EXTRINSICS_ERROR[1]
        title, observation = f"extrinsics {expected.child}", f"{1e3 * apart:.0f} mm, {turn:.1f} deg from the file"
        found.append(Check(title, Verdict.OPEN, observation, "nodes with `extrinsics: file` use the file's; with `tf`, correct one of them")
                     if expected.child in replaced and not good else
                     make_check(title, good, observation, "one of them is wrong: measure, calibrate, and correct it"))
    return found


def check_frames(odometry: OdometryState | None, imu: ImuSample | None, placed: bool) -> list[Check]:
    """Check the names of frames; `placed`: whether the axes of the IMU are known."""
    return [make_check(f"frame {name}", value is not None and good, "nothing" if value is None else repr(value.frame), advice)
            for name, value, good, advice in (
                ("odometry", odometry, odometry is not None and odometry.frame == "map", "must be 'map'"),
                ("imu/data_raw", imu, placed, "must be 'imu_link', or placed in base_link by /tf_static or --sensors"))]


def camera_rotation(turned_B: np.ndarray, turned_C: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the orthogonal matrix that best maps the camera's rates to the gyroscope's (orthogonal Procrustes problem).

    It is a rotation if both are right-handed; its determinant is -1 if one axis, or all three, have the wrong sign.

    Args:
        turned_B: mean rates of the gyroscope between frames in B [rad/s], (n, 3).
        turned_C: mean rates of the camera between frames in C [rad/s], (n, 3).

    Returns:
        R_BC, (3, 3), and the root mean square of the rates about the axis with the least rotation [rad/s].
    """
    U, _, Vt = np.linalg.svd(turned_B.T @ turned_C)
    return U @ Vt, float(np.linalg.svd(turned_B, compute_uv=False)[2] / np.sqrt(max(len(turned_B), 1)))


def check_rotation(name: str, turned_B: np.ndarray, turned_C: np.ndarray, cameras: Vehicle | Sensors) -> Check:
    """Check the rotation between a camera and the IMU, and the gyroscope's scale, while the vehicle is rotated by hand.

    `turned_B` and `turned_C` are those of `camera_rotation`.
    """
    title, advice = f"rotation camera_{name} to IMU", (
        "rotate the vehicle back and forth about all axes, by 20 deg, over a textured surface (--shake)")
    if len(turned_B) < 20:
        return Check(title, Verdict.OPEN, f"{len(turned_B)} pairs of frames", advice)
    if not np.isfinite(turned_B).all():
        return Check(title, Verdict.FAILED, "the gyroscope's rates are not finite", "correct its driver")
    R, least = camera_rotation(turned_B, turned_C)
    if least < MIN_ROTATION_RATE:
        return Check(title, Verdict.OPEN, f"{least:.2f} rad/s about the axis turned about least, {MIN_ROTATION_RATE:g} are needed", advice)
    if np.linalg.det(R) < 0.0:
        return Check(title, Verdict.FAILED, f"left-handed: R_BC would be {np.round(R, 2).tolist()}",
                     "the sign of one axis of the gyroscope is wrong (or of all three): correct it in its driver")
    camera_rates = turned_C @ R.T
    scale = float(np.sum(turned_B * camera_rates) / np.sum(camera_rates**2))
    if abs(scale - 1.0) > MAX_SCALE_ERROR:
        return Check(title, Verdict.FAILED, f"the gyroscope reads {scale:.3g} times the camera's rates",
                     "its unit (rad/s) or scale is wrong, or the camera's focal length")
    residual = float(np.linalg.norm(turned_B - scale * camera_rates) / np.linalg.norm(turned_B))
    if residual > MAX_RESIDUAL:
        return Check(title, Verdict.FAILED, f"{100 * residual:.0f} % of the gyroscope's rates are not the camera's",
                     "an axis of the gyroscope has another scale, the clocks differ, or the scene moves: check these, and repeat")
    off = degrees(float(np.linalg.norm(so3.log(cameras.mounts[name].R_BC.T @ R))))
    return make_check(title, off < MAX_ROTATION_ERROR, f"{off:.1f} deg from the file",
                      f"R_BC is about {np.round(R, 2).tolist()}: correct `orientation` in the file, or the IMU's axes")


@dataclass(frozen=True)
class CommandResult:
    """Effect of a command to the controller.

    Attributes:
        status: newest status after the wait for the effect; None: none was received.
        delay: time to the effect, or of the time-out [s].
        armed: whether the latest command to the vehicle after it is armed; None: there was none.
    """

    status: ControllerStatus | None
    delay: float
    armed: bool | None


def check_command(name: str, result: CommandResult, state: int, armed: bool) -> Check:
    """Check the effect of a command: the controller's state, and whether the commands to the vehicle are armed."""
    status = result.status
    good = status is not None and status.state == state and result.delay <= RESPONSE_TIME and result.armed is armed
    sent = "none" if result.armed is None else "armed" if result.armed else "disarmed"
    observation = "no controller/status" if status is None else (
        f"{_STATES.get(status.state, status.state)} after {result.delay:.2f} s, commands {sent}: {status.message[:80]}")
    return make_check(name, good, observation, "see the controller's message; odometry must be available, and the vehicle level")


def check_watchdog(last_command: float | None, last_motion: float | None, bound: float = STOP_TIME) -> Check:
    """Check that the motors stop when commands end, from the times of the last command and of the last turning of a rotor [s]."""
    title, advice = "watchdog", "with the props off: --watchdog, and stop the controller's process when asked"
    if last_command is None:
        return Check(title, Verdict.OPEN, "commands did not end", advice)
    if last_motion is None:
        return Check(title, Verdict.OPEN, "no source reports that the motors turned until the last command and stopped after it (rotor_state, "
                     "or `armed` in /diagnostics)", "stop the controller while the motors turn; without a source, watch the motors")
    return make_check(title, last_motion - last_command <= bound,
                      f"the motors stopped {last_motion - last_command:.2f} s after the last command",
                      f"they must stop within {bound:g} s: do not fly until they do")


def check_takeover(turned: bool, armed: bool | None) -> Check:
    """Check that the pilot's switch stops the motors while commands continue.

    Args:
        turned: whether the motors turned before.
        armed: whether armed commands to the vehicle continued when the motors stopped; None: the motors did not stop.
    """
    title = "pilot's takeover"
    if not turned or armed is False:
        return Check(title, Verdict.OPEN, "the commands ended" if turned else
                     "no source reports that the motors turn (rotor_state, or `armed` in /diagnostics)",
                     "with the props off: --takeover, and flip the pilot's switch when asked")
    return make_check(title, armed is True, "the motors stopped while commands went on" if armed else "the motors went on turning",
                      "with the pilot's arming switch off, the takeover switch must stop them: check its channel and range (MSP OVERRIDE)")
