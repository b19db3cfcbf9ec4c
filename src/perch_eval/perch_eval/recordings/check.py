"""Checks for what would make perception fail on a recording: rates, gaps, jitter, units, noise, exposure, blur, clocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from perch_core.values import ImuSample
from perch_eval.recordings.camera_check import ImageStatistics, check_camera, check_clocks
from perch_eval.recordings.findings import Report
from perch_eval.recordings.imu_check import check_imu
from perch_eval.recordings.recording import Event, Recording

DAY = 86_400_000_000_000  # [ns]


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
    elif len(times) > 10 and np.ptp(times) > 0 and sensors.imu is not None:
        check_clocks(report, recording, times, imu, sensors, sensors.imu.R_BI)
    return report
