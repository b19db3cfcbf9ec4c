"""Trace of a flight: the values of every channel except the cameras', and the outcome."""

from __future__ import annotations

from typing import Any

from perch_core.component import Component, Output, ports
from perch_core.values import Contact, TrajectoryOrder, nanoseconds
from perch_eval.flight import Flight, timed


def stamp_of(value: Any) -> int:
    """Return the stamp of a value as in its message's header [ns]; of a trajectory order, its start time."""
    return nanoseconds(value.trajectory.start_time) if isinstance(value, TrajectoryOrder) else value.stamp


class FlightTrace:
    """Trace of one flight.

    Attributes:
        outcome: `perched`, or the lower-case name of the mission's result; `timeout` past the time limit.
        message: message of the mission's result.
        end_time: simulation time of the goal's end [s].
        wall_time: wall-clock time of the flight [s].
        phases: (time [s], phase, message) of the mission at every change.
    """

    def __init__(self) -> None:
        self.outcome, self.message = "failed", ""
        self.end_time = self.wall_time = float("nan")
        self.phases: list[tuple[float, str, str]] = []
        self._values: dict[str, list[Any]] = {}

    def tap(self, component: Component[Any]) -> None:
        """Record the outputs of a component, except camera channels, debug images, log lines and channels with absolute names."""
        for port in ports(type(component), Output):
            channel = port.channel(component)
            if port is not Component.log and not channel.startswith(("/", "camera_")) and channel != "vio/debug_image":
                getattr(component, port.name).receivers.append(self._values.setdefault(channel, []).append)

    def values(self, channel: str) -> list[Any]:
        """Return the values of a channel in the order of emission; empty: there are none."""
        return list(self._values.get(channel, ()))

    def timeline(self) -> list[tuple[str, int, Any]]:
        """Return (channel, stamp [ns], value) of all values, sorted by stamp."""
        entries = [(channel, stamp_of(value), value) for channel, values in sorted(self._values.items()) for value in values]
        return sorted(entries, key=lambda entry: entry[1])

    @property
    def flight(self) -> Flight:
        """The trace as a flight, the form in which recordings are read and metrics computed."""
        return Flight({channel: timed(values) for channel, values in self._values.items() if values})

    @property
    def contacts(self) -> list[Contact]:
        """True contacts of the vehicle."""
        return self.values("contact")
