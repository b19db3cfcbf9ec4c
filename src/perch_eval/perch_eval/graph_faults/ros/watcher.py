"""Observation of a flight by the campaign: true state, rotor speeds, contacts and the controller's status."""

from __future__ import annotations

import math
from functools import partial
from typing import Any

import numpy as np
from std_msgs.msg import String

from perch_control.modes import State
from perch_core.ros import topics
from perch_core.values import seconds
from perch_eval.ending import Situation
from perch_eval.metrics import tilt_degrees
from perch_eval.ros.mission_client import MissionClient
from perch_sim.contact_event import ContactState

CHANNELS = ("ground_truth/odometry", "rotor_state", "contact", "controller/status")


class Watcher:
    """Subscribes with the pilot's node; only the newest message of each channel is decoded, and only on demand.

    Attributes:
        contacts: all contacts, in order.
    """

    def __init__(self, pilot: MissionClient) -> None:
        self._newest: dict[str, bytes] = {}
        self.contacts: list[Any] = []
        self._start: tuple[float, ...] | None = None
        node = pilot.node
        for channel in CHANNELS:
            row = topics.topic(channel)
            node.create_subscription(row.message, channel, partial(self._on_message, channel), row.qos.subscribe, raw=True)
        self._fault = node.create_publisher(String, "relay/fault", topics.topic("trajectory").qos.publish)

    def _on_message(self, channel: str, message: bytes) -> None:
        self._newest[channel] = message
        if channel == "contact":
            self.contacts.append(topics.decode(channel, message))
        elif channel == "ground_truth/odometry" and self._start is None:
            self._start = topics.decode(channel, message).p_WB

    def disturb(self, fault: str) -> None:
        """Set the disturbance of the relay."""
        self._fault.publish(String(data=fault))

    def _value(self, channel: str) -> Any:
        newest = self._newest.get(channel)
        return None if newest is None else topics.decode(channel, newest)

    @property
    def position(self) -> tuple[float, ...] | None:
        """True position of the centre of mass in W [m]; None: not received yet."""
        state = self._value("ground_truth/odometry")
        return None if state is None else state.p_WB

    @property
    def height(self) -> float:
        """Height above the vehicle's place before the flight [m]."""
        p = self.position
        return 0.0 if p is None or self._start is None else p[2] - self._start[2]

    @property
    def time(self) -> float:
        """Stamp of the newest true state [s]; 0: not received yet."""
        state = self._value("ground_truth/odometry")
        return 0.0 if state is None else seconds(state.stamp)

    def situation(self) -> Situation | None:
        """Return the present situation; None: true state or rotor speeds not received yet."""
        state, rotors, status = map(self._value, ("ground_truth/odometry", "rotor_state", "controller/status"))
        if state is None or rotors is None:
            return None
        held = [c.state for c in self.contacts if c.state in (ContactState.NONE, ContactState.ATTACHED)][-1:] == [ContactState.ATTACHED]
        hovers = status is not None and status.state == State.HOVERING
        return Situation(self.height, math.dist(state.v_WB, (0.0,) * 3), float(tilt_degrees(np.array(state.q_WB))),
                         max(rotors.speed), held, hovers)
