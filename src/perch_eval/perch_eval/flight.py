"""A recorded flight as arrays."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rclpy.serialization import deserialize_message

from perch_core.ros.conversions import odometry_arrays, pose_arrays, to_array, to_seconds
from perch_eval.mcap_log import message_class, read

HASHED = ("ground_truth/odometry", "imu/data_raw", "odometry", "vio/odometry", "target/pose", "trajectory",
          "motor_command", "controller/reference")


@dataclass(frozen=True)
class States:
    """States over time: t (n,), p (n,3), q (n,4) xyzw, v in W (n,3), w in B (n,3)."""

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    w: np.ndarray

    def at(self, times: np.ndarray) -> States:
        """The states at given times; vectors are interpolated, the attitude is that of the nearest sample."""
        def between(values: np.ndarray) -> np.ndarray:
            return np.stack([np.interp(times, self.t, column) for column in values.T], axis=1)

        nearest = np.clip(np.searchsorted(self.t, times), 0, len(self.t) - 1)
        return States(np.asarray(times), between(self.p), self.q[nearest], between(self.v), between(self.w))


class Flight:
    """The messages of one flight by topic (without leading slash or namespace of the vehicle).

    Attributes:
        damage: why the recording could not be read to its end; empty if it could.
    """

    damage = ""

    def __init__(self, path: Path, namespace: str = "") -> None:
        self._raw: dict[str, list[tuple[float, Any]]] = {}
        prefix = f"/{namespace.strip('/')}/" if namespace.strip("/") else "/"
        classes: dict[str, Any] = {}
        for topic, name, time, data in read(path, on_damage=self._damaged):
            key = topic.removeprefix(prefix).lstrip("/")
            msg_type = classes.setdefault(name, message_class(name))
            self._raw.setdefault(key, []).append((time * 1e-9, deserialize_message(data, msg_type)))

    def _damaged(self, why: str) -> None:
        self.damage = why

    def messages(self, topic: str) -> list[tuple[float, Any]]:
        """(time [s], message) of a topic, in the order recorded; empty when there are none."""
        return self._raw.get(topic, [])

    @property
    def topics(self) -> list[str]:
        """The topics that carry messages."""
        return sorted(self._raw)

    def states(self, topic: str) -> States | None:
        """The states of an odometry topic, in the order of their stamps."""
        rows = [(to_seconds(m.header.stamp), *odometry_arrays(m)) for _, m in self.messages(topic)]
        if len(rows) < 2:
            return None
        rows.sort(key=lambda row: row[0])
        return States(*(np.array(column) for column in zip(*rows)))

    def vectors(self, topic: str, pick) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and `pick(message)` (n, ...) of a topic."""
        rows = self.messages(topic)
        return np.array([t for t, _ in rows]), np.array([pick(m) for _, m in rows])

    def reference(self) -> States | None:
        """What the controller wanted at each step while it followed a trajectory."""
        rows = []
        for t, m in self.messages("controller/reference"):
            p, q = pose_arrays(m.pose)
            rows.append((t, p, q, to_array(m.linear_velocity), to_array(m.angular_velocity)))
        return States(*(np.array(column) for column in zip(*rows))) if len(rows) > 1 else None

    def digest(self, until: float) -> str:
        """SHA-256 over the values of every state, command and estimate up to a time [s] (the `flight_hash`)."""
        total = hashlib.sha256()
        for topic in HASHED:
            total.update(topic.encode())
            for t, msg in self.messages(topic):
                if t <= until:
                    total.update(np.array(_numbers(msg), float).tobytes())
        return total.hexdigest()


def _numbers(value: Any) -> list[float]:
    """Every number of a message, depth first."""
    if isinstance(value, (bool, int, float)):
        return [float(value)]
    if isinstance(value, str):
        return [float(b) for b in value.encode()]
    if isinstance(value, np.ndarray):
        return value.astype(float).ravel().tolist()
    if hasattr(value, "get_fields_and_field_types"):
        return [x for name in value.get_fields_and_field_types() for x in _numbers(getattr(value, name))]
    return [x for item in value for x in _numbers(item)]
