"""A flight as values by channel, and as arrays: recorded (`perch_eval.ros.recorded_flight`) or flown in this process."""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Any

import numpy as np

from perch_core.errors import PerchError
from perch_core.values import ControlReference, OdometryState, TrajectoryOrder, seconds

HASHED = ("ground_truth/odometry", "imu/data_raw", "odometry", "vio/odometry", "target/pose", "trajectory",
          "motor_command", "controller/reference")
GAP = 0.1  # between states, beyond which those between them are not known [s]


@dataclass(frozen=True)
class States:
    """States over time: t (n,), p (n,3), q (n,4) xyzw, v in W (n,3), w in B (n,3)."""

    t: np.ndarray
    p: np.ndarray
    q: np.ndarray
    v: np.ndarray
    w: np.ndarray

    def chosen(self, rows: np.ndarray) -> States:
        """Return the states that a mask selects."""
        return States(self.t[rows], self.p[rows], self.q[rows], self.v[rows], self.w[rows])

    def covers(self, times: np.ndarray) -> np.ndarray:
        """Return a mask of the times that lie within the states and not in a gap longer than `GAP`, shape (n,)."""
        right = np.clip(np.searchsorted(self.t, times), 1, len(self.t) - 1)
        return (times >= self.t[0]) & (times <= self.t[-1]) & (self.t[right] - self.t[right - 1] <= GAP)

    def at(self, times: np.ndarray) -> States:
        """The states at given times; vectors are interpolated, the attitude is that of the next sample."""
        following = np.clip(np.searchsorted(self.t, times), 0, len(self.t) - 1)
        p, v, w = (interpolated(times, self.t, values) for values in (self.p, self.v, self.w))
        return States(np.asarray(times), p, self.q[following], v, w)


def interpolated(times: np.ndarray, t: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Values (n, m) of times t (n,) at other times (k,), shape (k, m)."""
    return np.stack([np.interp(times, t, column) for column in values.T], axis=1)


def time_of(value: Any) -> float | None:
    """Return the time of a value [s]: its stamp, or the start of a trajectory; None if it has neither."""
    if isinstance(value, TrajectoryOrder):
        return value.trajectory.start_time
    stamp = getattr(value, "stamp", None)
    return None if stamp is None else seconds(stamp)


def timed(values: Iterable[Any]) -> list[tuple[float, Any]]:
    """(time [s], value) of each value that has a time."""
    return [(time, value) for value in values if (time := time_of(value)) is not None]


class Flight:
    """The values of one flight by channel, without leading slash.

    Attributes:
        source: description of the flight, or its recording, for messages.
        damage: why the recording could not be read to its end; empty if it could.
    """

    def __init__(self, channels: dict[str, list[tuple[float, Any]]], source: str = "the flight", damage: str = "") -> None:
        """
        Args:
            channels: (time [s], value) of each channel, in the order in which they were emitted.
            source, damage: as above.
        """
        self._channels, self.source, self.damage = channels, source, damage

    def values(self, channel: str) -> list[tuple[float, Any]]:
        """(time [s], value) of a channel, in order; empty when there are none."""
        return self._channels.get(channel, [])

    @property
    def topics(self) -> list[str]:
        """The channels that carry values."""
        return sorted(self._channels)

    def states(self, channel: str) -> States | None:
        """Return the states of an odometry channel in the order of their stamps; None if there are fewer than two."""
        found: list[OdometryState] = sorted((value for _, value in self.values(channel)), key=lambda state: state.stamp)
        return _states(found, "p_WB", "q_WB", "v_WB", "w_B")

    def known_states(self, channel: str) -> States:
        """Return `states` of a channel that must have them.

        Raises:
            PerchError: the channel has fewer than two states.
        """
        found = self.states(channel)
        if found is None:
            raise PerchError(f"{self.source}: holds no {channel}" + (f" as far as it can be read ({self.damage})" if self.damage else ""))
        return found

    def vectors(self, channel: str, pick: Callable[[Any], Any]) -> tuple[np.ndarray, np.ndarray]:
        """Times (n,) and `pick(value)` (n, ...) of a channel."""
        rows = self.values(channel)
        return np.array([t for t, _ in rows]), np.array([pick(value) for _, value in rows])

    def reference(self) -> States | None:
        """Return the controller's reference at each step of its trajectories; None if there are fewer than two."""
        found: list[ControlReference] = [value for _, value in self.values("controller/reference")]
        return _states(found, "p", "q", "v", "w")

    def digest(self, until: float) -> str:
        """SHA-256 over the values of every state, command and estimate up to a time [s] (the `flight_hash`)."""
        total = hashlib.sha256()
        for channel in HASHED:
            total.update(channel.encode())
            for t, value in self.values(channel):
                if t <= until:
                    total.update(np.array(numbers(value), float).tobytes())
        return total.hexdigest()


def _states(found: Sequence[Any], *names: str) -> States | None:
    """Return `States` of values with a stamp and these four fields; None if there are fewer than two."""
    if len(found) < 2:
        return None
    stamps = np.array([value.stamp for value in found], dtype=np.int64)
    return States(seconds(stamps), *(np.array([getattr(value, name) for value in found]) for name in names))


def numbers(value: Any) -> list[float]:
    """Every number of a value, depth first."""
    if isinstance(value, (bool, int, float)):
        return [float(value)]
    if value is None:
        return []
    if isinstance(value, str):
        return [float(b) for b in value.encode()]
    if isinstance(value, np.ndarray):
        return value.astype(float).ravel().tolist()
    if isinstance(value, Enum):
        return numbers(value.value)
    if dataclasses.is_dataclass(value):
        return [x for field in dataclasses.fields(value) for x in numbers(getattr(value, field.name))]
    return [x for item in value for x in numbers(item)]
