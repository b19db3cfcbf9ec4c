"""ROS 2 messages over Foxglove's WebSocket protocol: the serialised bytes with their definitions, as in an MCAP file."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable

import foxglove
import foxglove.websocket

from perch_eval.mcap_log import Schema
from perch_eval.view.gate import Gate, hidden_host, unservable


class LiveServer(foxglove.websocket.ServerListener):
    """Serves topics until it is closed. Time is simulation time."""

    def __init__(self, host: str, port: int, name: str, origins: Iterable[str]) -> None:
        """
        Args:
            host, port: address that is served; port 0: any free one.
            name: shown to clients.
            origins: of web pages that may look, see `perch_eval.view.gate.allowed`.

        Raises:
            ConfigError: the port is in use, or the address is not one of this machine.
        """
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._kept: dict[str, deque[tuple[bytes, int]]] = {}  # topic -> its last messages, for those who come later
        hidden = hidden_host()
        self._server = foxglove.start_server(name=name, host=hidden, port=0, context=self._context, server_listener=self,
                                             capabilities=[foxglove.Capability.Time])
        try:
            self._gate = Gate(host, port, (hidden, self._server.port), origins)
        except OSError as error:
            self._server.stop()
            raise unservable(host, port, error) from None

    @property
    def port(self) -> int:
        """The port that is served."""
        return self._gate.port

    def __contains__(self, topic: str) -> bool:
        """Whether a topic has been declared."""
        return topic in self._channels

    def add_topic(self, topic: str, schema: Schema) -> None:
        """Declare a topic with its type."""
        described = foxglove.Schema(name=schema.name, encoding="ros2msg", data=schema.definition.encode())
        self._channels[topic] = foxglove.Channel(topic, message_encoding="cdr", schema=described, context=self._context)

    def watched(self, topic: str) -> bool:
        """Return whether the topic has subscribers."""
        return self._channels[topic].has_sinks()

    def send(self, topic: str, data: bytes, time: int, keep: int = 0) -> None:
        """Send one serialised message; `time` is simulation time [ns]. The last `keep` ones are resent on later subscriptions."""
        if keep:
            self._kept.setdefault(topic, deque(maxlen=keep)).append((data, time))
        self._channels[topic].log(data, log_time=time)

    def on_subscribe(self, client: foxglove.websocket.Client, channel: foxglove.websocket.ChannelView) -> None:
        """Resend the kept messages of a newly subscribed topic; called by the server's thread."""
        for data, time in tuple(self._kept.get(channel.topic, ())):
            self._channels[channel.topic].log(data, log_time=time)

    def tell_time(self, time: int) -> None:
        """Broadcast simulation time [ns]."""
        self._server.broadcast_time(time)

    def close(self) -> None:
        """Stop serving and close all connections."""
        self._server.stop()
        self._gate.close()
