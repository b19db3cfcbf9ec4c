"""What a slow participant works on: batches of packets, begun when their images are drawn, and its place in the order of a flight."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from perch_core.values import CameraImage
from perch_sim.lockstep.packet import Packet
from perch_sim.lockstep.participant import Participant
from perch_sim.lockstep.tasks import Task


class Arrival(NamedTuple):
    """A camera frame that has arrived.

    Attributes:
        camera: its name.
        stamp: as in its header [ns].
        middle: of the exposure, on the IMU's clock [ns].
        image: as emitted; None: the camera takes no images, or this one is lost.
    """

    camera: str
    stamp: int
    middle: int
    image: CameraImage | None


class Batch:
    """Work of a slow participant."""

    __slots__ = ("stamp", "due", "packets", "begun", "results")

    def __init__(self, stamp: int, due: int, packets: list[Packet]) -> None:
        self.stamp, self.due, self.packets = stamp, due, packets
        self.begun = False
        self.results: Sequence[Packet] = ()


class Place:
    """A participant's place in the order, taken or empty.

    Attributes:
        inbox: what has come since the last batch.
        coming: slow: batches without results yet, oldest first; one at a time is worked on.
        done: slow: batches whose results do not count yet.
        last: step of the last batch.
    """

    def __init__(self, name: str, task: Task) -> None:
        self.name, self.task = name, task
        self.latency = 0 if task.latency is None else round(task.latency * 1e9)
        self.participant: Participant | None = None
        self.inbox: list[Packet] = []
        self.coming: deque[Batch] = deque()
        self.done: deque[Batch] = deque()
        self.last = 0

    @property
    def inputs(self) -> frozenset[str]:
        """Channels that its participant takes."""
        return frozenset() if self.participant is None else self.participant.inputs

    @property
    def takes_images(self) -> bool:
        """Whether images are among what its participant takes."""
        return any(channel.endswith("/image_raw") for channel in self.inputs)

    def awaits(self, arrival: Arrival) -> bool:
        """Whether a frame starts work: with its image for those who take images."""
        if f"camera_{arrival.camera}/image_raw" in self.inputs:
            return arrival.image is not None
        return f"camera_{arrival.camera}/camera_info" in self.inputs


def _is_image(packet: Packet) -> bool:
    return packet.channel.endswith("/image_raw")


def is_drawn(image: CameraImage, timeout: float = 0.0) -> bool:
    """Whether an image is there, or is within a time [s]."""
    return image.ready is None or image.ready(timeout)


def first_undrawn(batch: Batch) -> Packet | None:
    """The first packet of a batch whose image is still being drawn."""
    return next((packet for packet in batch.packets
                 if _is_image(packet) and not is_drawn(packet.value)), None)


def is_lost(packet: Packet) -> bool:
    """Whether it is an image that will never come. One that is drawn when it is looked at always comes."""
    return _is_image(packet) and packet.value.ready is not None and packet.value.pixels() is None
