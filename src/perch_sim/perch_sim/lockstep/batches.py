"""Batches of packets for slow participants, begun when their images are rendered, and slots in the order of a flight."""

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
        camera: name of the camera.
        stamp: stamp of the frame's header [ns].
        middle: middle of the exposure, on the IMU's clock [ns].
        image: image as emitted; None: the camera takes no images, or this one is lost.
    """

    camera: str
    stamp: int
    middle: int
    image: CameraImage | None


class Batch:
    """Batch of packets for a slow participant, with its results."""

    __slots__ = ("stamp", "due", "packets", "begun", "results")

    def __init__(self, stamp: int, due: int, packets: list[Packet]) -> None:
        self.stamp, self.due, self.packets = stamp, due, packets
        self.begun = False
        self.results: Sequence[Packet] = ()


class Slot:
    """Slot of a participant in the order, occupied or empty.

    Attributes:
        inbox: packets received since the last batch.
        pending: batches of a slow participant without results, oldest first; one at a time is processed.
        done: batches of a slow participant whose results are not due yet.
        last: step of the last batch.
    """

    def __init__(self, name: str, task: Task) -> None:
        self.name, self.task = name, task
        self.latency = 0 if task.latency is None else round(task.latency * 1e9)
        self.participant: Participant | None = None
        self.inbox: list[Packet] = []
        self.pending: deque[Batch] = deque()
        self.done: deque[Batch] = deque()
        self.last = 0

    @property
    def inputs(self) -> frozenset[str]:
        """Input channels of its participant."""
        return frozenset() if self.participant is None else self.participant.inputs

    @property
    def takes_images(self) -> bool:
        """Whether its participant has images among its inputs."""
        return any(channel.endswith("/image_raw") for channel in self.inputs)

    def is_triggered_by(self, arrival: Arrival) -> bool:
        """Return whether a frame triggers work; a participant that takes images requires the image."""
        if f"camera_{arrival.camera}/image_raw" in self.inputs:
            return arrival.image is not None
        return f"camera_{arrival.camera}/camera_info" in self.inputs


def _is_image(packet: Packet) -> bool:
    return packet.channel.endswith("/image_raw")


def is_rendered(image: CameraImage, timeout: float = 0.0) -> bool:
    """Return whether an image has been rendered; wait for it up to a time [s]."""
    return image.ready is None or image.ready(timeout)


def first_pending_image(batch: Batch) -> Packet | None:
    """Return the first packet of a batch whose image is still being rendered, or None."""
    return next((packet for packet in batch.packets
                 if _is_image(packet) and not is_rendered(packet.value)), None)


def is_lost(packet: Packet) -> bool:
    """Return whether a packet is an image that was lost; images that are rendered on demand never are."""
    return _is_image(packet) and packet.value.ready is not None and packet.value.pixels() is None
