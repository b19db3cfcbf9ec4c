"""ROS 2 messages over Foxglove's WebSocket protocol: the serialised bytes with their definitions, as in an MCAP file."""

from __future__ import annotations

from collections.abc import Sequence

import foxglove
import foxglove.websocket
from foxglove.messages import FrameTransform, FrameTransforms, Quaternion, Timestamp, Vector3

from perch_core.errors import ConfigError
from perch_core.ros.conversions import NANOSECONDS
from perch_eval.mcap_log import message_definition
from perch_eval.view.address import ADVICE

Frame = tuple[str, str, Sequence[float], Sequence[float]]
"""Parent, child, position of the child [m] (3,), its attitude xyzw (4,)."""


class LiveServer(foxglove.websocket.ServerListener):
    """Serves topics until it is closed. Time is simulation time."""

    def __init__(self, host: str, port: int, name: str) -> None:
        """
        Raises:
            ConfigError: the port is taken, or the address is none of this machine's.
        """
        self._context = foxglove.Context()
        self._channels: dict[str, foxglove.Channel] = {}
        self._latched: dict[str, tuple[bytes, int]] = {}  # topic -> its last message, for those who come later
        try:
            self._server = foxglove.start_server(name=name, host=host, port=port, context=self._context, server_listener=self,
                                                 capabilities=[foxglove.Capability.Time])
        except RuntimeError as error:
            raise ConfigError("viewer", "port", f"{host}:{port} cannot be served ({str(error).split(': ')[-1]}); {ADVICE}") from None
        self._frames = foxglove.channels.FrameTransformsChannel("/tf", context=self._context)

    @property
    def port(self) -> int:
        """The port that is served."""
        return self._server.port

    def add_topic(self, topic: str, name: str) -> None:
        """Declare a topic with its type, `package/msg/Name`."""
        schema = foxglove.Schema(name=name, encoding="ros2msg", data=message_definition(name).encode())
        self._channels[topic] = foxglove.Channel(topic, message_encoding="cdr", schema=schema, context=self._context)

    def watched(self, topic: str) -> bool:
        """Somebody looks at the topic."""
        return self._channels[topic].has_sinks()

    def send(self, topic: str, data: bytes, time: int, latched: bool = False) -> None:
        """Send one serialised message; `time` is simulation time [ns]. A latched one is sent again to who subscribes later."""
        if latched:
            self._latched[topic] = data, time
        self._channels[topic].log(data, log_time=time)

    def on_subscribe(self, client: foxglove.websocket.Client, channel: foxglove.websocket.ChannelView) -> None:
        """Somebody begins to look; called by the server's thread."""
        last = self._latched.get(channel.topic)
        if last is not None:
            self._channels[channel.topic].log(last[0], log_time=last[1])

    def send_frames(self, time: int, frames: Sequence[Frame]) -> None:
        """Send where frames are, as /tf."""
        stamp = Timestamp(sec=time // NANOSECONDS, nsec=time % NANOSECONDS)
        self._frames.log(FrameTransforms(transforms=[
            FrameTransform(timestamp=stamp, parent_frame_id=parent, child_frame_id=child,
                           translation=Vector3(x=float(p[0]), y=float(p[1]), z=float(p[2])),
                           rotation=Quaternion(x=float(q[0]), y=float(q[1]), z=float(q[2]), w=float(q[3])))
            for parent, child, p, q in frames]), log_time=time)

    def tell_time(self, time: int) -> None:
        """Tell simulation time [ns]."""
        self._server.broadcast_time(time)

    def close(self) -> None:
        """Say goodbye to everybody who looks."""
        self._server.stop()
