"""Opening of a recording by its kind, and ROS bags: rosbag2 (a folder with `metadata.yaml`, or one `.mcap` or `.db3`) and ROS 1 `.bag`,
read by `rosbags` without ROS."""

from __future__ import annotations

import tempfile
from collections import Counter
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, closing
from pathlib import Path
from typing import Any

from perch_core.errors import PerchError
from perch_core.ros.messages.sensing import compressed_value, image_value, imu_value
from perch_core.sensors import Sensors
from perch_core.values import CameraImage, ImuSample
from perch_eval.extras import require
from perch_eval.mcap_log import is_truncated, recover
from perch_eval.recordings.recording import IMU, AslRecording, Event, ImageFolder, Recording, RecordingError, image_files, root_of

IMAGES = {"sensor_msgs/msg/Image": image_value, "sensor_msgs/msg/CompressedImage": compressed_value}
IMU_TYPE = "sensor_msgs/msg/Imu"
WIDE = {"mono16": "mono8", "16UC1": "mono8"}
SUFFIXES = (".bag", ".mcap", ".db3")


def open_recording(path: Path, sensors: Sensors | None, camera: str | None = None) -> Recording:
    """Open the recording at a path.

    Args:
        path: a bag, a folder in the ASL format, a folder of images or an image.
        sensors: its calibration; None: the recording's own, if there is one.
        camera: that of a folder of images or an image; None: the first of `sensors`.

    Raises:
        RecordingError: it is none of these, or cannot be read.
        ConfigError: its calibration cannot be used.
    """
    if not path.exists():
        raise RecordingError(f"{path}: no such recording")
    if path.suffix in SUFFIXES if path.is_file() else (path / "metadata.yaml").is_file():
        return BagRecording(path, sensors)
    if path.is_dir() and root_of(path) is not None:
        return AslRecording(path, sensors)
    if image_files(path):
        return ImageFolder(path, sensors, camera)
    raise RecordingError(f"{path}: is no recording: neither a bag (.bag, .mcap, .db3, a folder with metadata.yaml), nor a folder in the "
                         "format of EuRoC (mav0/cam0/data.csv), nor images")


class BagRecording(Recording):
    """A bag. A camera's topic is the one in the sensor file, or else `camera_<name>/image_raw` (or `/compressed` below it).

    A truncated `.mcap` is read as far as possible, from a copy that has an index.

    Attributes:
        truth_topic: topic of the simulator's true motion of the body, beside the IMU's; empty: it is not recorded.
    """
    def __init__(self, path: Path, sensors: Sensors | None) -> None:
        """
        Raises:
            RecordingError: it cannot be read, or has none of the topics.
        """
        super().__init__(path, sensors)
        self._readable, self._truncation = path, ""
        if path.is_file() and path.suffix == ".mcap" and is_truncated(path):
            self._copy = tempfile.TemporaryDirectory(prefix="perch_recording_")  # goes with this recording
            self._readable = Path(self._copy.name) / path.name
            self._truncation = self.damage = recover(path, self._readable)
        with self._open() as reader:
            kinds = {c.topic: c.msgtype for c in reader.connections}
            self._counts = counts = {topic: info.msgcount for topic, info in reader.topics.items()}
        if self._truncation and not counts:
            raise RecordingError(f"{path}: cannot be read: {self._truncation}")
        pictures = {topic for topic, kind in kinds.items() if kind in IMAGES}
        imus = sorted(topic for topic, kind in kinds.items() if kind == IMU_TYPE)
        if sensors is None:
            self._cameras = {_camera_name(topic): topic for topic in sorted(pictures)}
            self._imu = imus[0] if imus else ""
            if not pictures and not imus:
                raise RecordingError(f"{path}: has neither images nor samples of an IMU (sensor_msgs: Image, CompressedImage, Imu); its topics: "
                                     f"{', '.join(sorted(kinds)) or 'none'}")
        else:
            found = {name: _topic((camera.topic, f"camera_{name}/image_raw"), pictures) for name, camera in sensors.cameras.items()}
            self._cameras = {name: topic for name, topic in found.items() if topic}
            if not self._cameras:
                raise RecordingError(
                    f"{path}: none of the cameras' topics (`topic`, or camera_<name>/image_raw) of sensor file {sensors.name}; images are on: "
                    f"{', '.join(sorted(pictures)) or 'none'}")
            self._imu = _topic((sensors.imu.topic, "imu/data_raw"), set(imus)) if sensors.imu is not None else ""
            if sensors.imu is not None and not self._imu:
                raise RecordingError(f"{path}: no IMU on {sensors.imu.topic or 'imu/data_raw'} (`topic` of the IMU in sensor file {sensors.name}) "
                                     f"or imu/data_raw; there are: {', '.join(imus) or 'none'}")
        truth = self._imu.removesuffix("imu/data_raw") + "ground_truth/odometry"
        self.truth_topic = truth if truth in kinds else ""
        self.images = {name: counts[topic] for name, topic in self._cameras.items()}
        self.samples = counts[self._imu] if self._imu else 0

    def events(self) -> Iterator[Event]:
        """Yield events in the order of their recording. Images that cannot be used are left out and reported in `damage`."""
        sources = {topic: name for name, topic in self._cameras.items()}
        if self._imu:
            sources[self._imu] = IMU
        unusable: dict[str, Counter[str]] = {}  # topic -> reasons, which may quote sizes
        self.damage = self._truncation
        with self._open() as reader:
            messages = reader.messages([c for c in reader.connections if c.topic in sources])
            while True:
                try:
                    connection, arrived, data = next(messages)
                    value = self._value(sources[connection.topic], connection, reader.deserialize(data, connection.msgtype))
                except StopIteration:
                    break
                except PerchError as error:
                    unusable.setdefault(connection.topic, Counter())[str(error)] += 1
                    continue
                except Exception as error:  # whatever the libraries make of a damaged file
                    self.damage = f"{type(error).__name__}: {error}"
                    break
                yield Event(sources[connection.topic], value, arrived)
        texts = [f"{reasons.total()} of {self._counts[topic]} messages of {topic} cannot be used: {reasons.most_common(1)[0][0]}"
                 for topic, reasons in unusable.items()]
        self.damage = "; ".join(filter(None, [*texts, self.damage]))

    def poses(self, topic: str) -> list[tuple[Any, ...]]:
        """(stamp [ns], x, y, z [m], qx, qy, qz, qw) of each message of a topic.

        Raises:
            RecordingError: there is no such topic, or its messages are no poses.
        """
        rows: list[tuple[Any, ...]] = []
        with self._open() as reader:
            connections = [c for c in reader.connections if c.topic == topic]
            if not connections:
                raise RecordingError(f"{self.path}: no topic {topic}")
            kind = connections[0].msgtype
            try:
                for connection, _, data in reader.messages(connections):
                    message = reader.deserialize(data, connection.msgtype)
                    inner = getattr(message, "pose", getattr(message, "transform", None))
                    inner, stamp = getattr(inner, "pose", inner), message.header.stamp
                    rows.append((stamp.sec * 1_000_000_000 + stamp.nanosec, *_numbers(inner)))
            except AttributeError:
                raise RecordingError(f"{self.path}: {topic}: {kind} is no stamped pose, transform or odometry") from None
            except Exception as error:  # whatever the libraries make of a damaged file
                raise RecordingError(f"{self.path}: {topic}: {error}") from None
        return rows

    def _open(self) -> AbstractContextManager[Any]:
        """Return a context manager with an open reader.

        Raises:
            RecordingError: the file is not a bag, or is damaged.
        """
        require("recordings")
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        try:
            reader = AnyReader([self._readable], default_typestore=get_typestore(Stores.ROS2_JAZZY))
            reader.open()
        except Exception as error:  # whatever the libraries make of a damaged file
            raise RecordingError(f"{self.path}: cannot be read: {' '.join(str(error).split()) or type(error).__name__}") from None
        return closing(reader)

    def _value(self, source: str, connection: Any, message: Any) -> ImuSample | CameraImage:
        """Convert a message to a value.

        Raises:
            PerchError: an image has an unknown encoding or cannot be decoded.
        """
        if source == IMU:
            return imu_value(message)._replace(frame="imu_link")
        if getattr(message, "encoding", "") in WIDE:  # the upper 8 of 16 bits
            message.data = message.data.reshape(-1, 2)[:, 0 if message.is_bigendian else 1].copy()
            message.step, message.encoding = message.step // 2, WIDE[message.encoding]
        return IMAGES[connection.msgtype](message)


def _numbers(pose: Any) -> tuple[float, ...]:
    """x y z qx qy qz qw of a geometry_msgs Pose or Transform."""
    p, q = (pose.position, pose.orientation) if hasattr(pose, "position") else (pose.translation, pose.rotation)
    return p.x, p.y, p.z, q.x, q.y, q.z, q.w


def _topic(requested: Iterable[str], available: set[str]) -> str:
    """Return the available topic that matches the first possible one, up to slash, namespace and `/compressed`; empty if none does."""
    for topic in filter(None, requested):
        names = (end := "/" + topic.lstrip("/"), f"{end}/compressed")
        if found := [one for one in names if one in available] or [one for one in sorted(available) if one.endswith(names)]:
            return found[0]
    return ""


def _camera_name(topic: str) -> str:
    """Return a camera name for a topic: `down` for camera_down/image_raw; otherwise from the whole topic."""
    first = topic.strip("/").removesuffix("/compressed").removesuffix("/image_raw")
    return first.rpartition("camera_")[2].replace("/", "_") or "camera"
