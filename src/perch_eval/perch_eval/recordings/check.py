"""Checks for what would make perception fail on a recording. Of a camera: rate, exposure, sharpness, texture; clock and mounting
against the IMU by the angular rates of both."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress

import cv2
import numpy as np

from perch_core import so3
from perch_core.sensors import Sensors
from perch_core.values import CameraImage, ImuSample
from perch_eval.camera_turns import CameraTurns
from perch_eval.flight import interpolated
from perch_eval.recordings.imu_check import Report, check_imu, check_rate
from perch_eval.recordings.recording import Event, Recording
from perch_perception.images import ImageError, image_array

DAY = 86_400_000_000_000  # [ns]
SAMPLED_IMAGES = 60  # images of each camera whose pixels are evaluated
SPAN = 8.0  # of the interval that is evaluated [s]
OFFSETS = np.arange(-0.5, 0.501, 0.002)  # of the images' stamps that are tried [s]
MIN_RATE_SIGMA = 0.2  # least 1 sigma of usable rates [rad/s]
MATCHING, MISMATCHING = 0.25, 0.7  # share of the images' rotation that the gyro does not explain: below, they match, above, they do not
MAX_FACTOR = 3.0  # between the two in one unit


def check(recording: Recording, events: Iterator[Event] | None = None) -> Report:
    """Check a recording.

    Args:
        recording: compared with its sensor file if it has one.
        events: of the recording, for example with a progress display; None: they are read here.
    """
    report, sensors = Report(), recording.sensors
    stamps, samples = [], []
    cameras = {name: ImageStatistics(n) for name, n in recording.images.items()}
    for event in events or recording.events():
        if isinstance(event.value, ImuSample):
            stamps.append(event.value.stamp)
            samples.append((*event.value.w_B, *event.value.f_B))
        else:
            cameras[event.source].add(event.value, event.arrived)
    if recording.damage:
        report.add("recording", recording.damage, warning=True)
    if not stamps:
        missing = "the sensor file describes no IMU" if sensors is not None and sensors.imu is None else "there is no IMU"
        report.add("imu", f"{missing}: only single images can be evaluated", warning=True)
    imu = np.array(samples).reshape(-1, 6)
    times = np.array(stamps, np.int64)
    if len(times):
        near = np.abs(times - np.median(times)) < DAY
        if not near.all():
            report.add("imu stamps", f"{int((~near).sum())} are more than a day from the others", warning=True)
            imu, times = imu[near], times[near]
    if len(times) > 10:
        check_imu(report, times, imu, sensors.imu if sensors else None)
    elif len(times):
        report.add("imu", f"{len(times)} samples are too few", fails=True)
    for name, statistics in cameras.items():
        check_camera(report, name, statistics, times, sensors)
    if sensors is None:
        report.add("calibration", "none: give --sensors FILE, made by `sensors.py import`", warning=True)
    elif sensors.imu is not None:
        good = np.isfinite(imu).all(axis=1)
        times, first = np.unique(times[good], return_index=True)
        if len(times) > 10:
            check_clocks(report, recording, times, imu[good][first], sensors, sensors.imu.R_BI)
    return report


class ImageStatistics:
    """Collects stamps and sampled image properties of a camera."""
    def __init__(self, total: int) -> None:
        self.stamps: list[int] = []
        self.delays: list[int] = []
        self.sizes: set[tuple[int, int]] = set()
        self.samples: list[tuple[float, ...]] = []
        self.unreadable = 0  # sampled images without pixels
        self._every = max(1, total // SAMPLED_IMAGES)

    def add(self, image: CameraImage, arrived: int | None = None) -> None:
        """Add an image and the time of its recording [ns], if that is known."""
        if len(self.stamps) % self._every == 0:
            pixels = image.pixels()
            if pixels is None:
                self.unreadable += 1
            else:
                self.sizes.add((pixels.shape[1], pixels.shape[0]))
                self.samples.append(measure_image(pixels))
        self.stamps.append(image.stamp)
        if arrived is not None:
            self.delays.append(arrived - image.stamp)


def measure_image(pixels: np.ndarray) -> tuple[float, ...]:
    """Return brightness, share of saturated pixels, edge width [px] and number of corners of an image, uint8 (h, w) or (h, w, 3).

    The width of an edge is its step, over three pixels to either side, over its slope; median of the steepest 2 % of pixels.
    """
    grey = pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY)
    slope = 0.125 * cv2.magnitude(cv2.Sobel(grey, cv2.CV_32F, 1, 0), cv2.Sobel(grey, cv2.CV_32F, 0, 1))
    box = np.ones((7, 7), np.uint8)
    step = cv2.subtract(cv2.dilate(grey, box), cv2.erode(grey, box)).astype(np.float32)
    edges = (slope > np.percentile(slope, 98)) & (step > 20)
    width = float(np.median(step[edges] / slope[edges])) if edges.sum() > 50 else np.nan
    corners = cv2.goodFeaturesToTrack(cv2.GaussianBlur(grey, (0, 0), 1.5), 400, 0.01, 15)
    return float(grey.mean()), float((grey >= 250).mean()), width, float(0 if corners is None else len(corners))


def check_camera(report: Report, name: str, statistics: ImageStatistics, imu_stamps: np.ndarray, sensors: Sensors | None) -> None:
    sensor = sensors.cameras.get(name) if sensors else None
    stamps, about = np.array(statistics.stamps, np.int64), f"camera {name}"
    if len(stamps) == 0:
        report.add(about, "no image", fails=True)
        return
    if sensor is not None and statistics.sizes - {(sensor.width, sensor.height)}:
        sizes = ", ".join(f"{w} x {h}" for w, h in sorted(statistics.sizes))
        report.add(about, f"images of {sizes} px, the calibration is of {sensor.width} x {sensor.height}", fails=True)
    if not statistics.samples:
        report.add(about, "no image could be decoded", fails=True)
        return
    if statistics.unreadable:
        sampled = statistics.unreadable + len(statistics.samples)
        report.add(f"{about} files", f"{statistics.unreadable} of {sampled} sampled images could not be decoded", warning=True)
    if len(imu_stamps):
        if not (np.diff(stamps) > 0).all():
            report.add(f"{about} stamps", f"{int((np.diff(stamps) <= 0).sum())} are not newer than the one before", warning=True)
        different = np.unique(stamps)
        if len(different) > 2:
            check_rate(report, about, different, minimum=5.0, recommended=10.0, nominal=None)
        elif len(stamps) > 2:
            report.add(f"{about} stamps", "all are the same: the driver does not stamp", fails=True)
        outside = float(((stamps < imu_stamps[0]) | (stamps > imu_stamps[-1])).mean())
        if outside > 0.02:
            gap = 1e-9 * max(imu_stamps[0] - stamps[0], stamps[-1] - imu_stamps[-1])
            report.add(f"{about} clock", f"{100 * outside:.0f} % of the images lie outside the IMU's time, by up to {gap:.3f} s",
                       warning=outside < 0.5, fails=outside >= 0.5)
    if len(imu_stamps) and statistics.delays:
        median, p99 = np.percentile(statistics.delays, (50, 99)) * 1e-6
        report.add(f"{about} delay", f"recorded {median:.0f} ms after the stamp (median; 99 % within {p99:.0f} ms)",
                   warning=bool(median < -1.0 or p99 > 500.0))
    brightness, bright, width, corners = (np.array(column) for column in zip(*statistics.samples))
    report.figures[f"{name}_corners"] = float(np.median(corners))
    report.add(f"{about} exposure",
               f"mean brightness {np.median(brightness):.0f} of 255, {100 * np.median(bright):.1f} % of the pixels saturated",
               warning=bool(np.median(brightness) < 25 or np.median(bright) > 0.2), fails=bool(np.median(brightness) < 5))
    if np.isfinite(width).any():
        worst, blurred = float(np.nanpercentile(width, 90)), float(np.nanmedian(width))
        report.figures[f"{name}_edge_px"] = blurred
        why = ": out of focus, or moved while exposed" if blurred > 6.0 else ""
        report.add(f"{about} sharpness",
                   f"edges are {blurred:.1f} px wide in the median, {worst:.1f} px in the worst tenth of the images{why}",
                   warning=blurred > 6.0)
    few = float((corners < 30).mean())
    report.add(f"{about} texture",
               f"{np.median(corners):.0f} corners in the median" + (f"; under 30 in {100 * few:.0f} % of the images" if few else ""),
               warning=few > 0.1, fails=few > 0.8)


def check_clocks(report: Report, recording: Recording, stamps: np.ndarray, imu: np.ndarray, sensors: Sensors, R_BI: np.ndarray) -> None:
    """Check time offset and rotation between each camera and the IMU by the best fit of their angular rates."""
    begin = _most_dynamic_interval(stamps, imu[:, :3])
    end = begin + round(SPAN * 1e9)
    turns = {name: CameraTurns(sensors.cameras[name].camera) for name in recording.images if name in sensors.cameras}
    for event in recording.events():
        image = event.value
        if event.source not in turns or not isinstance(image, CameraImage) or not begin <= image.stamp <= end:
            continue
        with suppress(ImageError):
            turns[event.source].add(image.stamp, image_array(image, sensors.cameras[event.source].camera))
    for name, found in turns.items():
        if len(found.spans) < 20:
            continue
        rows = np.array([(1e-9 * (before - stamps[0]), 1e-9 * (after - stamps[0]), *rate) for before, after, rate in found.spans])
        R_CI = sensors.mounts[name].R_BC.T @ R_BI
        _check_clock(report, name, rows, 1e-9 * (stamps - stamps[0]), imu[:, :3] @ R_CI.T, sensors.cameras[name].stamp_offset)


def _check_clock(report: Report, name: str, turns: np.ndarray, stamps: np.ndarray, gyro_C: np.ndarray, nominal: float) -> None:
    """Check mounting and clock of one camera; `nominal` is the offset in the sensor file [s], the others are as in `gyro_rates`."""
    rate, gyro_rate = turns[:, 2:], gyro_rates(turns, stamps, gyro_C)
    R, mismatch = mounting(rate, gyro_rate)
    if mismatch < MATCHING:
        gyro_rate, angle = gyro_rate @ R, float(np.degrees(np.linalg.norm(so3.log(R))))
        report.add(f"camera {name} mounting", f"{angle:.1f} deg from the sensor file, by the rotation of camera and gyro", fails=angle > 10.0)
    offset, sigma = clock_offset(rate, gyro_rate, 0.5 * (turns[:, 0] + turns[:, 1]))
    if sigma > 0.01:
        spread = gyro_rate.std(axis=1).mean(axis=0)
        usable = spread > MIN_RATE_SIGMA
        if usable.any() and unexplained(rate, gyro_rate)[usable].min() > MISMATCHING:
            report.add(f"camera {name} clock", f"the rotation of the images does not match the gyro's at any offset up to {OFFSETS[-1]:g} s: "
                       "clock, axes or unit are wrong, or the scene moves", warning=True, fails=bool(spread[2] > MIN_RATE_SIGMA))
        else:
            report.add(f"camera {name} clock", "not checked: rotation is too slow, or the scene too close, to compare it "
                       f"with the IMU's ({1e3 * sigma:.0f} ms, 1 sigma)", warning=True)
        return
    report.figures[f"{name}_stamp_offset_s"] = offset
    beyond, edge = abs(offset - nominal) - 3.0 * sigma, abs(offset) > OFFSETS[-2]
    report.add(f"camera {name} clock",
               f"stamps are {'more than ' if edge else ''}{1e3 * offset:+.0f} ms ({1e3 * sigma:.0f} ms, 1 sigma) from the IMU's clock, by "
               f"the rotation of both, {1e3 * nominal:+.0f} ms in the sensor file",
               warning=beyond > 0.005, fails=edge or beyond > 0.02)


def _most_dynamic_interval(stamps: np.ndarray, gyro: np.ndarray) -> int:
    """Return the start of the interval of length `SPAN` in which the angular rate varies most [ns]."""
    edges = np.arange(stamps[0], max(stamps[-1] - round(SPAN * 1e9), stamps[0] + 1), 1_000_000_000)
    spans = [gyro[slice(*np.searchsorted(stamps, [edge, edge + round(SPAN * 1e9)]))] for edge in edges]
    return int(edges[int(np.argmax([np.linalg.norm(span - span.mean(axis=0), axis=1).mean() if len(span) else 0.0 for span in spans]))])


def gyro_rates(turns: np.ndarray, stamps: np.ndarray, gyro_C: np.ndarray) -> np.ndarray:
    """Return the gyro's mean rates between image stamps, for each offset in `OFFSETS` of these stamps.

    Args:
        turns: stamps of two images [s], mean rate between them in C [rad/s], shape (n, 5).
        stamps: of the gyro on the same clock [s], shape (m,).
        gyro_C: angular rate in the axes of C [rad/s], shape (m, 3).

    Returns:
        Shape (k, n, 3) [rad/s].
    """
    integral = np.vstack([np.zeros(3), np.cumsum(0.5 * (gyro_C[1:] + gyro_C[:-1]) * np.diff(stamps)[:, None], axis=0)])
    begin, end = (interpolated((turns[:, k] - OFFSETS[:, None]).ravel(), stamps, integral).reshape(len(OFFSETS), -1, 3) for k in (0, 1))
    return (end - begin) / (turns[:, 1] - turns[:, 0])[:, None]


def mounting(rate: np.ndarray, gyro_rate: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the rotation that best maps the camera's rates to the gyro's, at the best offset, and the unexplained share.

    The share is infinite if the rotation is about one axis only. For the arguments see `clock_offset`.
    """
    rate, gyro_rate = rate - rate.mean(axis=0), gyro_rate - gyro_rate.mean(axis=1, keepdims=True)
    size = np.linalg.svd(rate, compute_uv=False)
    if size[1] < MIN_RATE_SIGMA * np.sqrt(len(rate)):
        return np.eye(3), np.inf
    found = [(R := so3.nearest(one.T @ rate), float(np.linalg.norm(one - rate @ R.T) / np.linalg.norm(rate))) for one in gyro_rate]
    return min(found, key=lambda pair: pair[1])


def unexplained(rate: np.ndarray, gyro_rate: np.ndarray) -> np.ndarray:
    """Return the share of the camera's rates about each axis that the gyro's, times a factor, do not explain, shape (3,).

    Translation close to the scene changes the factor. One above `MAX_FACTOR`, or below its inverse, is another unit: it explains
    nothing. For the arguments see `clock_offset`.
    """
    rate, gyro_rate = rate - rate.mean(axis=0), gyro_rate - gyro_rate.mean(axis=1, keepdims=True)
    factor = (rate * gyro_rate).sum(axis=1) / np.maximum((gyro_rate**2).sum(axis=1), 1e-12)
    share = np.linalg.norm(rate - factor[:, None] * gyro_rate, axis=1) / np.maximum(np.linalg.norm(rate, axis=0), 1e-12)
    return np.where((factor > 1.0 / MAX_FACTOR) & (factor < MAX_FACTOR), share, 1.0).min(axis=0)


def clock_offset(rate: np.ndarray, gyro_rate: np.ndarray, times: np.ndarray) -> tuple[float, float]:
    """Estimate the time offset of the image stamps against the gyro's, and its uncertainty.

    Args:
        rate: of the camera [rad/s], shape (n, 3).
        gyro_rate: of the gyro at each offset, from `gyro_rates` [rad/s], shape (k, n, 3).
        times: of the rates [s], shape (n,).

    Returns:
        Stamp minus IMU time [s], from the axis with the least uncertainty, and its 1 sigma: rate difference over slope and over the root
        of the number of independent differences. Neighbours are alike where translation close to the scene looks like rotation.
    """
    slope, axes = np.abs(np.gradient(gyro_rate, times, axis=1)).mean(axis=1), np.arange(3)
    single = (rate - gyro_rate).std(axis=1) / np.maximum(slope, 1e-9)
    best = np.argmin(single, axis=0)
    difference = rate - gyro_rate[best, :, axes].T
    difference = difference - difference.mean(axis=0)
    alike = (difference[1:] * difference[:-1]).sum(axis=0) / np.maximum((difference**2).sum(axis=0), 1e-12)
    alike = np.clip(alike, 0.0, 0.99)
    sigma = single[best, axes] * np.sqrt((1.0 + alike) / (1.0 - alike) / len(rate))
    axis = int(np.argmin(sigma))
    return float(OFFSETS[best[axis]]), float(sigma[axis])
