"""A camera's images judged: size, rate, exposure, sharpness, texture; and its clock against the IMU's, by the turns that both see."""

from __future__ import annotations

from contextlib import suppress

import cv2
import numpy as np

from perch_core.sensors import Sensors
from perch_core.values import CameraImage
from perch_eval.camera_turns import CameraTurns
from perch_eval.recordings.findings import Report, check_rhythm
from perch_eval.recordings.recording import Recording
from perch_perception.images import ImageError, image_array

LOOKED_AT = 60  # images of each camera whose pixels are looked at
CORRELATED = 5.0  # frames over which errors of an image's turn go together
SPAN, REACH = 8.0, 0.1  # of the stretch that is looked at, and of the offsets tried [s]


class Looker:
    """What is kept of a camera's images."""
    def __init__(self, total: int) -> None:
        self.stamps: list[int] = []
        self.delays: list[int] = []
        self.sizes: set[tuple[int, int]] = set()
        self.looks: list[tuple[float, ...]] = []
        self._every = max(1, total // LOOKED_AT)

    def take(self, image: CameraImage, arrived: int) -> None:
        """An image, and when it was recorded [ns]."""
        if len(self.stamps) % self._every == 0:
            pixels = image.pixels()
            if pixels is not None:
                self.sizes.add((pixels.shape[1], pixels.shape[0]))
                self.looks.append(look_at(pixels))
        self.stamps.append(image.stamp)
        self.delays.append(arrived - image.stamp)


def look_at(pixels: np.ndarray) -> tuple[float, ...]:
    """Brightness, share of saturated pixels, width of its sharper edges [px], number of corners of an image uint8 (h, w) or (h, w, 3).

    The width of an edge is its step, over three pixels to either side, by its steepest slope; the median of the image's steepest.
    """
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    slope = 0.125 * cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    box = np.ones((7, 7), np.uint8)
    step = cv2.subtract(cv2.dilate(grey, box), cv2.erode(grey, box)).astype(np.float32)
    edges = (slope > np.percentile(slope, 98)) & (step > 20)
    width = float(np.median(step[edges] / slope[edges])) if edges.sum() > 50 else np.nan
    corners = cv2.goodFeaturesToTrack(cv2.GaussianBlur(grey, (0, 0), 1.5), 400, 0.01, 15)
    return float(grey.mean()), float((grey >= 250).mean()), width, float(0 if corners is None else len(corners))


def check_camera(report: Report, name: str, looker: Looker, imu_stamps: np.ndarray, sensors: Sensors | None) -> None:
    sensor = sensors.cameras.get(name) if sensors else None
    stamps, about = np.array(looker.stamps, np.int64), f"camera {name}"
    if len(stamps) == 0:
        report.say(about, "no image", fails=True)
        return
    if sensor is not None and looker.sizes - {(sensor.width, sensor.height)}:
        sizes = ", ".join(f"{w} x {h}" for w, h in sorted(looker.sizes))
        report.say(about, f"images of {sizes} px, the calibration is of {sensor.width} x {sensor.height}", fails=True)
    if not looker.looks:
        report.say(about, "no image could be decoded", fails=True)
        return
    if len(imu_stamps):
        if not (np.diff(stamps) > 0).all():
            report.say(f"{about} stamps", f"{int((np.diff(stamps) <= 0).sum())} are not newer than the one before", warning=True)
        if len(stamps) > 2:
            check_rhythm(report, about, np.unique(stamps), least=5.0, wanted=10.0, told=None)
        outside = float(((stamps < imu_stamps[0]) | (stamps > imu_stamps[-1])).mean())
        if outside > 0.02:
            gap = 1e-9 * max(imu_stamps[0] - stamps[0], stamps[-1] - imu_stamps[-1])
            report.say(f"{about} clock",
                       f"{100 * outside:.0f} % of the images lie outside the IMU's time, by up to {gap:.3f} s",
                       warning=outside < 0.5,
                       fails=outside >= 0.5)
        delays = 1e-9 * np.array(looker.delays)
        if np.any(delays != 0.0):
            report.say(
                f"{about} delay",
                f"recorded {1e3 * np.median(delays):.0f} ms after the stamp (median; 99 % within {1e3 * np.percentile(delays, 99):.0f} ms)",
                warning=bool(np.median(delays) < -1e-3 or np.percentile(delays, 99) > 0.5))
    brightness, bright, width, corners = (np.array(column) for column in zip(*looker.looks))
    report.figures[f"{name}_corners"] = float(np.median(corners))
    report.say(f"{about} exposure",
               f"mean brightness {np.median(brightness):.0f} of 255, {100 * np.median(bright):.1f} % of the pixels saturated",
               warning=bool(np.median(brightness) < 25 or np.median(bright) > 0.2),
               fails=bool(np.median(brightness) < 5))
    if np.isfinite(width).any():
        worst, blurred = float(np.nanpercentile(width, 90)), float(np.nanmedian(width))
        report.figures[f"{name}_edge_px"] = blurred
        why = ": out of focus, or moved while exposed" if blurred > 6.0 else ""
        report.say(f"{about} sharpness",
                   f"edges are {blurred:.1f} px wide in the median, {worst:.1f} px in the worst tenth of the images{why}",
                   warning=blurred > 6.0)
    few = float((corners < 30).mean())
    report.say(f"{about} texture",
               f"{np.median(corners):.0f} corners in the median" + (f"; under 30 in {100 * few:.0f} % of the images" if few else ""),
               warning=few > 0.1,
               fails=few > 0.8)


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
