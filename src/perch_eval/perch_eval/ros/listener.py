"""Components that receive serialised messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

from perch_core.component import Component, Input
from perch_core.ros import topics
from perch_core.values import CameraImage, Serialized

CAMERAS = ("down", "front")
STAMPLESS = ("/tf", "/tf_static", "robot_description", "trajectory", "recovery")
"""Channels whose messages have no header, or a start time in the future as stamp: they get the newest stamp of the others."""

C = TypeVar("C")
T = TypeVar("T", bound=type[Component[Any]])


class Wire(Input[Serialized]):
    """Input of the serialised messages of a channel, handled by `on_message(channel, message)`."""

    def handler(self, component: Component[Any]) -> Callable[[Serialized], None]:
        """Return `on_message`, bound to the channel."""
        assert isinstance(component, Listener)
        return partial(component.on_message, self.channel(component))


class Images(Input[CameraImage]):
    """Input of the images of a camera, handled by `on_image(camera, image)`."""

    def __init__(self, camera: str) -> None:
        super().__init__(CameraImage, f"camera_{camera}/image_raw", lazy=True)
        self.camera = camera

    def handler(self, component: Component[Any]) -> Callable[[CameraImage], None]:
        """Return `on_image`, bound to the camera."""
        assert isinstance(component, Listener)
        return partial(component.on_image, self.camera)


class Listener(Component[C]):
    """A component that handles messages by `on_message(channel, message)` and images by `on_image(camera, image)`.

    Attributes:
        resolve: function from a channel to its fully resolved topic; set by a host with a namespace.
        newest: newest stamp so far [ns].
    """

    def __init__(self, config: C) -> None:
        super().__init__(config)
        self.resolve: Callable[[str], str] = lambda channel: f"/{channel.lstrip('/')}"
        self.newest = 0

    def on_message(self, channel: str, message: Serialized) -> None:
        """Handle a message of a channel."""
        raise NotImplementedError

    def on_image(self, camera: str, image: CameraImage) -> None:
        """Handle an image of a camera."""
        raise NotImplementedError

    def serialized(self, channel: str, message: Any) -> Serialized:
        """Return a message in serialised form, whichever form the host delivers; for `STAMPLESS`, with the newest stamp."""
        if not isinstance(message, Serialized):
            stamp = getattr(message, "stamp", 0)
            message = Serialized(self.resolve(channel), stamp, topics.encode(channel, message), topics.message_type(channel))
        if channel in STAMPLESS:
            return message._replace(stamp=self.newest)
        self.newest = max(self.newest, message.stamp)
        return message


def listening(channels: Iterable[str]) -> Callable[[T], T]:
    """Return a class decorator that gives a `Listener` a lazy port for each channel and camera."""

    def declare(cls: T) -> T:
        found: list[Wire | Images] = [*(Wire(Serialized, channel, lazy=True) for channel in channels), *map(Images, CAMERAS)]
        for port in found:
            name = "in_" + port._channel.strip("/").replace("/", "_")
            port.__set_name__(cls, name)
            setattr(cls, name, port)
        return cls

    return declare
