"""Subscriptions of preflight to a vehicle's graph, and commands to the controller where they are allowed."""

from __future__ import annotations

import time
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
from perch_eval.preflight.checks import ANSWER, Order
from perch_eval.ros.graph_node import GraphNode

COMMANDS = ("motor_command", "rates_thrust_command", "attitude_thrust_command")
CHANNELS = ("imu/data_raw", "odometry", "camera_down/camera_info", "camera_front/camera_info", "controller/status", "rotor_state",
            "/tf_static", "/diagnostics", *COMMANDS)
KEPT = 20_000       # values of a channel
DEEP = 2000         # messages that wait while this program does not run
TURNING = 0.02      # of its highest speed: a rotor that is faster turns
SETTLING = 0.3      # after an effect, until the commands are looked at [s]


class GraphListener(GraphNode):
    """Subscribes to all channels that are checked.

    Attributes:
        values: channel -> (arrival by the monotonic clock [s], value), the newest `KEPT`.
        turns: rotation of the watched camera; None: no camera is watched.
    """

    def __init__(self, vehicle: Vehicle, namespace: str = "") -> None:
        super().__init__("preflight", in_namespace(namespace))
        self.values: dict[str, list[tuple[float, Any]]] = {channel: [] for channel in CHANNELS}
        self.turns: CameraTurns | None = None
        self._fastest = vehicle.speed_max
        for channel in CHANNELS:
            row = topics.topic(channel)
            profile = copy(row.qos.subscribe)
            profile.depth = max(profile.depth, DEEP)
            self.node.create_subscription(row.message, channel, partial(self._take, channel, row), profile, raw=True)
        order = topics.topic("controller/command")
        self._orders = self.node.create_publisher(order.message, "controller/command", order.qos.publish)

    def _take(self, channel: str, row: topics.Topic, data: bytes) -> None:
        try:
            read = row.read(data)
        except PerchError:
            return
        kept = self.values[channel]
        kept += [(time.monotonic(), value) for value in (read if isinstance(read, list) else [read])]
        del kept[:-KEPT]

    def _look(self, row: topics.Topic, data: bytes) -> None:
        image = row.read(data)
        assert self.turns is not None
        self.turns.add(image.stamp, image.pixels())

    def await_first(self, channel: str, patience: float) -> None:
        """Wait for the first value of a channel, as discovery takes time; at most for `patience` [s]."""
        self.spin_until(lambda: self.values[channel], patience)

    def watch(self, camera: str, model: Camera) -> None:
        """Subscribe to the images of a camera to measure its rotation."""
        self.turns, row = CameraTurns(model), topics.topic(f"camera_{camera}/image_raw")
        self.node.create_subscription(row.message, f"camera_{camera}/image_raw", partial(self._look, row), row.qos.subscribe, raw=True)

    def stamped(self, channel: str) -> list[tuple[float, int]]:
        """Return (arrival [s], stamp [ns]) of the values of a channel."""
        return [(arrival, value.stamp) for arrival, value in self.values[channel]]

    def newest(self, channel: str) -> Any:
        """Return the newest value of a channel; None: there is none."""
        return self.values[channel][-1][1] if self.values[channel] else None

    def order(self, command: int, state: int) -> Order:
        """Send the controller a command and wait until it reports a state, or for a time-out."""
        stamp = getattr(self.newest("odometry"), "stamp", 0)
        row, begun = topics.topic("controller/command"), time.monotonic()
        self._orders.publish(row.to_message(ControllerCommand(stamp, command, "preflight, props off")))
        status = self.values["controller/status"]
        self.spin_until(lambda: status and status[-1][0] > begun and status[-1][1].state == state, 2.0 * ANSWER)
        delay = time.monotonic() - begun
        self.listen(SETTLING)
        sent = [value for channel in COMMANDS for arrival, value in self.values[channel][-1:] if arrival > begun]
        return Order(self.newest("controller/status"), delay, sent[-1].armed if sent else None)

    def await_end_of_commands(self, patience: float) -> tuple[float | None, float | None]:
        """Wait for the last command; return its time, and that of the last turning of a motor [s]; see `checks.stopped`."""
        end = time.monotonic() + patience
        while time.monotonic() < end:
            self.listen(0.1)
            last = max((self.values[channel][-1][0] for channel in COMMANDS if self.values[channel]), default=None)
            if last is not None and time.monotonic() - last > 3.0 * ANSWER:
                told = [entry for source in self._motion(last) for entry in source]
                return last, max((arrival for arrival, turns in told if turns), default=last) if told else None
        return None, None

    def await_takeover(self, patience: float) -> tuple[bool, bool | None]:
        """Return whether the motors turned, and whether armed commands continued when they stopped; see `checks.taken_over`."""
        begun, turned = time.monotonic(), False
        while time.monotonic() < begun + patience:
            self.listen(0.1)
            sources = self._motion(begun)
            turned = any(turns for told in sources for _, turns in told)
            if turned and not any(told[-1][1] for told in sources):
                sent = [value.armed for channel in COMMANDS for arrival, value in self.values[channel][-1:] if time.monotonic() - arrival < SETTLING]
                return True, any(sent)
        return turned, None

    def _motion(self, since: float) -> list[list[tuple[float, bool]]]:
        """Return (arrival [s], whether the motors turn) of each source since a time [s]; sources without values are left out."""
        rotors: list[tuple[float, RotorState]] = [entry for entry in self.values["rotor_state"] if entry[0] > since]
        turning = [(arrival, max(state.speed) > TURNING * self._fastest) for arrival, state in rotors]
        armed = [(arrival, str(said.values["armed"]).lower() == "true") for arrival, said in self.values["/diagnostics"]
                 if arrival > since and "armed" in said.values]
        return [told for told in (turning, armed) if told]
