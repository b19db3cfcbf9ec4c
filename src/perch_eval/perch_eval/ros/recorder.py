"""Component `recorder`: writes the messages of a flight to an MCAP file."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path

import cv2
import numpy as np

from perch_core.component import Diagnostics, LogLine, Timer
from perch_core.config import quantity, text
from perch_core.values import NANOSECONDS, CameraImage, CompressedPixels, Serialized
from perch_eval.mcap_log import McapLog
from perch_eval.ros.definitions import schema_of
from perch_eval.ros.listener import Listener, subscribed_to

CHANNELS = (
    "ground_truth/odometry", "ground_truth/target", "contact", "imu/data_raw", "rotor_state", "motor_command",
    "rates_thrust_command", "attitude_thrust_command",
    "odometry", "vio/odometry", "estimator/status", "target/pose", "target/detections", "powerlines", "trajectory", "recovery", "controller/command",
    "controller/status", "controller/reference", "/diagnostics", "/tf", "/tf_static", "robot_description")


@dataclass(frozen=True, kw_only=True)
class RecorderParameters:
    """Parameters of the node `recorder`."""

    file: str = text("flight.mcap", doc="where to write; an existing file is kept, and a number put into the name")
    image_rate: float = quantity(6.0, unit="Hz", low=0.0, high=60.0, doc="images kept per second and camera, 0: none")
    image_quality: int = quantity(80, unit="%", low=10, high=100, doc="JPEG quality")


@subscribed_to(CHANNELS)
class Recorder(Listener[RecorderParameters]):
    """Records serialised messages with simulation time, and some of the images as JPEG.

    A write error ends the recording, with one line of log, but not the flight.
    """

    config_type = RecorderParameters

    flush = Timer(0.1, stamping=True)

    def __init__(self, config: RecorderParameters) -> None:
        super().__init__(config)
        self._file = Path(config.file)
        self._log: McapLog | None = None
        self._last_image: dict[str, int] = {}
        self._messages, self._last_report = 0, -NANOSECONDS
        self._failure = ""

    def warm_up(self) -> None:
        """Open the file; where there is one of an earlier recording, a new one beside it, as `flight.1.mcap`."""
        try:
            self._file = _reserved(self._file)
            self._log = McapLog(self._file)
        except OSError as error:
            self._stop_recording(error)
        if self._file != Path(self.config.file):
            self.warn(f"{self.config.file} exists and is kept: recording to {self._file}")

    def on_message(self, channel: str, message: Serialized) -> None:
        """Write a message to the file."""
        self._write(self.serialized(channel, message))

    def on_image(self, camera: str, image: CameraImage) -> None:
        """Write an image to the file, by stamps at most `image_rate` per second."""
        if self.config.image_rate == 0.0 or self._log is None:
            return
        last = self._last_image.get(camera)
        if last is not None and last <= image.stamp < last + int(NANOSECONDS / self.config.image_rate):
            return
        self._last_image[camera] = image.stamp
        packed = jpeg(image, self.config.image_quality)
        if packed is not None:
            self._write(self.serialized(f"camera_{camera}/image_raw/compressed", packed))

    def on_flush(self, now: int) -> None:
        """Flush finished chunks to the operating system, and publish diagnostics once per second."""
        if self._log is not None:
            try:
                self._log.flush()
            except OSError as error:
                self._stop_recording(error)
        if abs(now - self._last_report) >= NANOSECONDS:
            self._report(now)

    def _report(self, now: int) -> None:
        self._last_report = now
        level, message = (2, self._failure) if self._failure else (0, "ok")
        self.diagnostics(Diagnostics(now, {"messages": self._messages}, level, message))

    def close(self) -> None:
        """Finish the file."""
        log, self._log = self._log, None
        if log is not None:
            try:
                log.close()
            except OSError as error:
                self._stop_recording(error)

    def _write(self, message: Serialized) -> None:
        if self._log is None:
            return
        try:
            self._log.write(message.topic, schema_of(message.message), message.data, message.stamp)
            self._messages += 1
        except OSError as error:
            self._stop_recording(error)

    def _stop_recording(self, error: OSError) -> None:
        log, self._log = self._log, None
        if log is not None:
            log.abandon()
        self._failure = f"recording stopped: {self._file}: {error.strerror or error}"
        self._report(self.host_time())
        self.log(LogLine("error", f"{self._failure}; the flight goes on, and what is written can be read"))


def _reserved(file: Path) -> Path:
    """Create the file, or if it exists the first of `<name>.1.<suffix>`, `<name>.2.<suffix>`, ... that does not, and return it.

    Raises:
        OSError: it cannot be created.
    """
    candidates = chain([file], (file.with_suffix(f".{k}{file.suffix}") for k in count(1)))
    while True:
        candidate = next(candidates)
        try:
            candidate.touch(exist_ok=False)
        except FileExistsError:
            if candidate.is_file():
                continue
        return candidate  # new, or a device


def jpeg(image: CameraImage, quality: int) -> CompressedPixels | None:
    """Encode an image as JPEG; None if it has no pixels. `quality` [%]."""
    pixels = image.pixels()
    if pixels is None:
        return None
    if image.encoding == "rgb8":
        pixels = pixels[..., ::-1]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(pixels), [cv2.IMWRITE_JPEG_QUALITY, quality])
    return CompressedPixels(image.stamp, image.frame, "jpeg", data.tobytes()) if done else None
