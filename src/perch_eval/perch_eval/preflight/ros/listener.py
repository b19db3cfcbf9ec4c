"""Subscriptions of preflight to a vehicle's graph, and commands to the controller where they are allowed."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterable, Sequence
from copy import copy
from functools import partial
from typing import Any

from perch_core.camera import Camera
from perch_core.errors import PerchError
from perch_core.ros import topics
from perch_core.values import ControllerCommand, RotorState
from perch_core.vehicle import Vehicle
from perch_eval.nodes import in_namespace
from perch_eval.camera_turns import CameraTurns
from perch_eval.preflight.checks import DESCENT_TIME, RESPONSE_TIME, CommandResult
from perch_eval.ros.graph_node import GraphNode

COMMANDS = ("motor_command", "rates_thrust_command", "attitude_thrust_command")
CHANNELS = ("imu/data_raw", "odometry", "controller/status", "rotor_state", "/tf_static", "/diagnostics", *COMMANDS)
MAX_VALUES = 20_000    # of a channel
QUEUE_DEPTH = 2000     # messages that wait while this program does not run
TURNING_SHARE = 0.02   # of its highest speed: a rotor that is faster turns
SETTLING_TIME = 0.3    # after an effect, until the commands are checked [s]

Reports = list[tuple[float, bool]]
"""(Arrival [s], whether the motors turn) of one source, in order."""


def last_motion(sources: Sequence[Reports], last: float) -> float | None:
    """Return when a motor turned last [s], at the earliest with the last command at `last` [s]; None: no source tells it.

    A source tells it if its motors turned when the commands ended, and it reported their stop, or their turning beyond every bound.
    """
    def tells(reports: Reports) -> bool:
        before = [turns for arrival, turns in reports if arrival <= last]
        newest, still_turns = reports[-1]
        return bool(before) and before[-1] and (not still_turns or newest > last + DESCENT_TIME)

    return max((max(arrival, last) for reports in sources if tells(reports) for arrival, turns in reports if turns), default=None)


class GraphListener(GraphNode):
    """Subscribes to all channels that are checked: `CHANNELS`, and `camera_info` of the cameras.

    Attributes:
        values: channel -> (arrival by the monotonic clock [s], value), the newest `MAX_VALUES`.
        turns: rotation of the watched camera; None: no camera is watched.
    """

    def __init__(self, vehicle: Vehicle, namespace: str = "", cameras: Iterable[str] = ()) -> None:
        super().__init__("preflight", in_namespace(namespace), (signal.SIGINT, signal.SIGTERM, signal.SIGHUP))  # none leaves it armed
        self.values: dict[str, list[tuple[float, Any]]] = {
            channel: [] for channel in (*CHANNELS, *(f"camera_{name}/camera_info" for name in cameras))}
        self.turns: CameraTurns | None = None
        self._speed_max, self._namespace = vehicle.speed_max, namespace.strip("/")
        for channel in self.values:
            row = topics.topic(channel)
            profile = copy(row.qos.subscribe)
            profile.depth = max(profile.depth, QUEUE_DEPTH)
            self.node.create_subscription(row.message, channel, partial(self._on_message, channel, row), profile, raw=True)
        command = topics.topic("controller/command")
        self._command_publisher = self.node.create_publisher(command.message, "controller/command", command.qos.publish)

    def _on_message(self, channel: str, row: topics.Topic, data: bytes) -> None:
        try:
            read = row.read(data)
        except PerchError:
            return
        values = self.values[channel]
        values += [(time.monotonic(), value) for value in (read if isinstance(read, list) else [read])]
        del values[:-MAX_VALUES]

    def _on_image(self, row: topics.Topic, data: bytes) -> None:
        assert self.turns is not None
        try:
            image = row.read(data)
            self.turns.add(image.stamp, image.pixels())
        except PerchError:
            return

    def await_first(self, channel: str, timeout: float) -> None:
        """Wait for the first value of a channel, as discovery takes time; at most for a time-out [s]."""
        self.spin_until(lambda: self.values[channel], timeout)

    def subscribe_camera(self, camera: str, model: Camera) -> None:
        """Subscribe to the images of a camera to measure its rotation."""
        self.turns, row = CameraTurns(model), topics.topic(f"camera_{camera}/image_raw")
        self.node.create_subscription(row.message, f"camera_{camera}/image_raw", partial(self._on_image, row), row.qos.subscribe, raw=True)

    def arrivals_and_stamps(self, channel: str) -> list[tuple[float, int]]:
        """Return (arrival [s], stamp [ns]) of the values of a channel."""
        return [(arrival, value.stamp) for arrival, value in self.values[channel]]

    def newest(self, channel: str) -> Any:
        """Return the newest value of a channel; None: there is none."""
        return self.values[channel][-1][1] if self.values[channel] else None

    def send_command(self, command: int, state: int) -> CommandResult:
        """Send the controller a command and wait until it reports a state, or for a time-out.

        It has no stamp: with that of odometry that has stopped, it would be ignored as too old, and the motors left on.
        """
        row, begun = topics.topic("controller/command"), time.monotonic()
        self._command_publisher.publish(row.to_message(ControllerCommand(0, command, "preflight, props off")))
        status = self.values["controller/status"]
        self.spin_until(lambda: status and status[-1][0] > begun and status[-1][1].state == state, 2.0 * RESPONSE_TIME)
        delay = time.monotonic() - begun
        self.spin_for(SETTLING_TIME)
        sent = [value for channel in COMMANDS for arrival, value in self.values[channel][-1:] if arrival > begun]
        return CommandResult(self.newest("controller/status"), delay, sent[-1].armed if sent else None)

    def await_end_of_commands(self, timeout: float) -> tuple[float | None, float | None]:
        """Wait for the last command; return its time, and that of the last turning of a motor [s]; see `checks.check_watchdog`."""
        begun = time.monotonic()
        while time.monotonic() < begun + timeout:
            self.spin_for(0.1)
            last = max((self.values[channel][-1][0] for channel in COMMANDS if self.values[channel]), default=None)
            if last is not None and time.monotonic() - last > DESCENT_TIME + RESPONSE_TIME:
                return last, last_motion(self._motor_reports(begun), last)
        return None, None

    def await_takeover(self, timeout: float) -> tuple[bool, bool | None]:
        """Return whether the motors turned, and whether armed commands continued when they stopped; see `checks.check_takeover`."""
        begun, turned = time.monotonic(), False
        while time.monotonic() < begun + timeout:
            self.spin_for(0.1)
            sources = self._motor_reports(begun)
            turned = any(turns for reports in sources for _, turns in reports)
            if turned and not any(reports[-1][1] for reports in sources):
                sent = [value.armed for channel in COMMANDS for arrival, value in self.values[channel][-1:]
                        if time.monotonic() - arrival < SETTLING_TIME]
                return True, any(sent)
        return turned, None

    def _motor_reports(self, since: float) -> list[Reports]:
        """Return the reports of each source since a time [s]; sources without reports are left out. Each
        node in the namespace that has `armed` in its diagnostics is a source."""
        rotors: list[tuple[float, RotorState]] = [entry for entry in self.values["rotor_state"] if entry[0] > since]
        turning = [(arrival, max(state.speed) > TURNING_SHARE * self._speed_max) for arrival, state in rotors]
        armed: dict[str, Reports] = {}
        for arrival, status in self.values["/diagnostics"]:  # of all vehicles
            node = str(status.values.get("node", ""))
            if arrival > since and "armed" in status.values and node.rpartition("/")[0].strip("/") == self._namespace:
                armed.setdefault(node, []).append((arrival, str(status.values["armed"]).lower() == "true"))
        return [reports for reports in (turning, *armed.values()) if reports]
