"""Components that receive serialised messages."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, TypeVar

from perch_core.component import Component, Input
from perch_core.ros import topics
from perch_core.values import CameraImage, Serialized

CAMERAS = ("down", "front")
WITHOUT_STAMP = ("/tf", "/tf_static", "robot_description", "trajectory", "recovery", "/diagnostics")
"""Channels whose messages have no header, a start time in the future as stamp, or, on `/diagnostics`, stamps of any node's clock:
they get the newest stamp of the others."""
STRAY = 2_000_000_000
"""A stamp that differs from the host's time by more than this is not used as time: the message is late, or of another clock [ns]."""

C = TypeVar("C")
T = TypeVar("T", bound=type[Component[Any]])


class SerializedInput(Input[Serialized]):
    """Input of the serialised messages of a channel, handled by `on_message(channel, message)`."""

    def handler(self, component: Component[Any]) -> Callable[[Serialized], None]:
        """Return `on_message`, bound to the channel."""
        assert isinstance(component, Listener)
        return partial(component.on_message, self.channel(component))


class ImageInput(Input[CameraImage]):
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
        host_time: function that returns the host's time [ns], 0 as long as there is none; set by a host.
        newest: newest stamp so far that is not stray [ns].
    """

    def __init__(self, config: C) -> None:
        super().__init__(config)
        self.resolve: Callable[[str], str] = lambda channel: f"/{channel.lstrip('/')}"
        self.newest = 0
        self.host_time: Callable[[], int] = lambda: 0

    def on_message(self, channel: str, message: Serialized) -> None:
        """Handle a message of a channel."""
        raise NotImplementedError

    def on_image(self, camera: str, image: CameraImage) -> None:
        """Handle an image of a camera."""
        raise NotImplementedError

    def serialized(self, channel: str, message: Any) -> Serialized:
        """Return a message in serialised form, whichever form the host delivers, with the time at which it is shown or recorded:
        its stamp, for `WITHOUT_STAMP` the newest stamp, or, where that is stray, the host's time."""
        if not isinstance(message, Serialized):
            kind = topics.message_type(channel)
            data = message if isinstance(message, bytes) else topics.encode(channel, message)
            message = Serialized(self.resolve(channel), topics.stamp_of(kind, data), data, kind)
        time, now = self.newest if channel in WITHOUT_STAMP else message.stamp, self.host_time()
        if time < 0 or (now and abs(time - now) > STRAY):
            if channel not in WITHOUT_STAMP and not 0 <= time <= now:  # not just late
                self.warn(f"{channel}: stamp {1e-9 * time:.3f} s is not of this clock, which shows {1e-9 * now:.3f} s", min_interval=1.0)
            return message._replace(stamp=now)
        self.newest = max(self.newest, time)
        return message._replace(stamp=time)


def subscribed_to(channels: Iterable[str]) -> Callable[[T], T]:
    """Return a class decorator that gives a `Listener` a lazy port for each channel and camera."""

    def declare(cls: T) -> T:
        found: list[SerializedInput | ImageInput] = [
            *(SerializedInput(Serialized, channel, lazy=True) for channel in channels), *map(ImageInput, CAMERAS)]
        for port in found:
            name = "in_" + port._channel.strip("/").replace("/", "_")
            port.__set_name__(cls, name)
            setattr(cls, name, port)
        return cls

    return declare
