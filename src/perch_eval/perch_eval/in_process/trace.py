"""What a flight leaves behind: the values of every channel but the cameras', and how it ended."""

from __future__ import annotations

from typing import Any

from perch_core.component import Component, Output, ports
from perch_core.values import Contact, TrajectoryOrder, nanoseconds
from perch_eval.flight import Flight, timed


def stamp_of(value: Any) -> int:
    """A value's own stamp, as its message's header has it [ns]; of an order that of its start."""
    return nanoseconds(value.trajectory.start_time) if isinstance(value, TrajectoryOrder) else value.stamp


class FlightTrace:
    """One flight.

    Attributes:
        outcome: `perched`, or the lower-case name of the mission's result; `timeout` past the time limit.
        message: the mission's words.
        end_time: when the goal ended [s].
        wall_time: what it took [s].
        phases: (time [s], phase, message) of the mission whenever they change.
    """

    def __init__(self) -> None:
        self.outcome, self.message = "failed", ""
        self.end_time = self.wall_time = float("nan")
        self.phases: list[tuple[float, str, str]] = []
        self._values: dict[str, list[Any]] = {}

    def tap(self, component: Component[Any]) -> None:
        """Keep what a component emits from now on, but for frames of cameras, log lines and what has an absolute name."""
        for port in ports(type(component), Output):
            channel = port.channel(component)
            if port is not Component.log and not channel.startswith(("/", "camera_")) and channel != "vio/debug_image":
                getattr(component, port.name).receivers.append(self._values.setdefault(channel, []).append)

    def values(self, channel: str) -> list[Any]:
        """The values of a channel in the order of emission; empty where there are none."""
        return list(self._values.get(channel, ()))

    def timeline(self) -> list[tuple[str, int, Any]]:
        """(channel, stamp [ns], value) of everything, by stamp."""
        entries = [(channel, stamp_of(value), value) for channel, values in sorted(self._values.items()) for value in values]
        return sorted(entries, key=lambda entry: entry[1])

    @property
    def flight(self) -> Flight:
        """As the figures are computed of, and as a recording is read."""
        return Flight({channel: timed(values) for channel, values in self._values.items() if values})

    @property
    def contacts(self) -> list[Contact]:
        """What the vehicle truly touched."""
        return self.values("contact")
