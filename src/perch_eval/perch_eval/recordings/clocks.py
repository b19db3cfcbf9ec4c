"""The clocks of camera and IMU compared, by the turns that both see."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from perch_core.sensors import Sensors
from perch_core.values import CameraImage
from perch_eval.camera_turns import CameraTurns
from perch_eval.recordings.findings import Report
from perch_eval.recordings.recording import Recording
from perch_perception.images import ImageError, image_array

CORRELATED = 5.0  # frames over which errors of an image's turn go together
SPAN, REACH = 8.0, 0.1  # of the stretch that is looked at, and of the offsets tried [s]


def check_clocks(report: Report, recording: Recording, stamps: np.ndarray, imu: np.ndarray, sensors: Sensors, R_BI: np.ndarray) -> None:
    """The time offset between each camera and the IMU, by which the turns that both see fit best."""
    begin = _liveliest(stamps, imu[:, :3])
    end = begin + round(SPAN * 1e9)
    turns = {name: CameraTurns(sensors.cameras[name].camera) for name in recording.images if name in sensors.cameras}
    for event in recording.events():
        image = event.value
        if event.source not in turns or not isinstance(image, CameraImage) or not begin <= image.stamp <= end:
            continue
        with suppress(ImageError):
            turns[event.source].add(image.stamp, image_array(image, sensors.cameras[event.source].camera))
    for name, seen in turns.items():
        if len(seen.spans) < 20:
            continue
        rows = [(1e-9 * (before - stamps[0]), 1e-9 * (after - stamps[0]), *rate) for before, after, rate in seen.spans]
        told = sensors.cameras[name].stamp_offset
        R_CI = sensors.mounts[name].R_BC.T @ R_BI
        offset, sigma = clock_offset(np.array(rows), 1e-9 * (stamps - stamps[0]), imu[:, :3] @ R_CI.T)
        if sigma > 0.01:
            report.say(f"camera {name} clock", f"turns are too slow to compare it with the IMU's ({1e3 * sigma:.0f} ms, 1 sigma)")
            continue
        report.figures[f"{name}_stamp_offset_s"] = offset
        beyond = abs(offset - told) - 3.0 * sigma
        report.say(f"camera {name} clock",
                   f"stamps are {1e3 * offset:+.0f} ms ({1e3 * sigma:.0f} ms, 1 sigma) from the IMU's clock by the turns that both "
                   f"see, {1e3 * told:+.0f} ms in the sensor file",
                   warning=beyond > 0.005,
                   fails=beyond > 0.02)


def _liveliest(stamps: np.ndarray, gyro: np.ndarray) -> int:
    """Where the stretch of `SPAN` with the most varied turns begins [ns]."""
    edges = np.arange(stamps[0], max(stamps[-1] - round(SPAN * 1e9), stamps[0] + 1), 1_000_000_000)
    spans = [gyro[slice(*np.searchsorted(stamps, [edge, edge + round(SPAN * 1e9)]))] for edge in edges]
    return int(edges[int(np.argmax([np.linalg.norm(span - span.mean(axis=0), axis=1).mean() for span in spans]))])


def clock_offset(turns: np.ndarray, stamps: np.ndarray, gyro_C: np.ndarray) -> tuple[float, float]:
    """By how much the images' stamps are late against the gyro's, and how alike the turns are then.

    Args:
        turns: stamp before, stamp after [s], mean rate between in C [rad/s], shape (n, 5).
        stamps: of the gyro on the same clock [s], shape (m,).
        gyro_C: angular rate in the axes of C [rad/s], shape (m, 3).

    Returns:
        Stamp minus IMU time [s], by the axis where the rates are most alike, and its 1 sigma: the rates' difference over their slope.
    """
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * (gyro_C[1:] + gyro_C[:-1]) * np.diff(stamps)[:, None], axis=0)])
    begin, end, rate = turns[:, 0], turns[:, 1], turns[:, 2:]
    offsets, best = np.arange(-REACH, REACH + 1e-9, 0.002), (0.0, np.inf)
    for axis in range(3):
        found = []
        for offset in offsets:
            felt = np.interp(end - offset, stamps, integral[:, axis]) - np.interp(begin - offset, stamps, integral[:, axis])
            felt /= end - begin
            slope = float(np.abs(np.gradient(felt, 0.5 * (begin + end))).mean())
            found.append((float((rate[:, axis] - felt).std()) / max(slope, 1e-9) / np.sqrt(len(rate) / CORRELATED), float(offset)))
        sigma, offset = min(found)
        best = min(best, (offset, sigma), key=lambda pair: pair[1])
    return best
