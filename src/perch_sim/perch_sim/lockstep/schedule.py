"""Order of a simulated flight: which component receives which packets at which step. Independent of ROS and of clocks.

Per control period, at the stamp t at which it ends:

1. The vehicle advances.
2. Results of slow participants that are due by t are delivered, sorted by channel, within a channel in order of emission; then
   the packets of the vehicle are delivered.
3. Fast participants work in sequence, each on the packets in its inbox; their outputs are delivered at once.
4. Slow participants whose frame has arrived, or whose period is over, receive all packets in their inbox as one batch.

Slow participants work while the flight continues, but their results take effect only at trigger + latency, however long the work
takes: the step at which they are due waits for them. A seed therefore gives the same flight on any machine, at any speed.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from operator import attrgetter
from typing import Any, NamedTuple, Protocol, cast

from perch_core.component import Component
from perch_core.errors import PerchError
from perch_core.values import CameraImage
from perch_sim.lockstep.batches import Arrival, Batch, Slot, first_pending_image, is_lost, is_rendered
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.participant import Emissions, Participant, handlers, packet_receiver
from perch_sim.lockstep.tasks import Task
from perch_sim.timing import CONTROL_PERIOD_NS

MAX_PENDING_IMAGES = 2         # frames of a camera that have arrived before their images
MAX_STEPS_WITHOUT_FRAME = 500  # after so many, a participant receives its inbox without a frame
LATCHED = ("/tf_static", "target/pose", "powerlines", "ground_truth/target")
_CHANNEL = attrgetter("channel")


class PendingInput(NamedTuple):
    """A missing input for which the flight waits: name of its source, description, and stamp [ns]."""

    name: str
    what: str
    since: int


class Vehicle(Protocol):
    """Component that owns the time of the flight; its inputs are handled on delivery."""

    time: int  # stamp of the step that it has reached [ns]

    def advance(self) -> Sequence[Arrival]:
        """Advance one control period, emit its outputs, and return the camera frames that have arrived."""


class _Routes(dict):
    """Channel -> receivers of its packets; found when a channel is first used."""

    def __init__(self, find: Callable[[str], list[Callable[[Packet], None]]]) -> None:
        super().__init__()
        self._find = find

    def __missing__(self, channel: str) -> list[Callable[[Packet], None]]:
        self[channel] = self._find(channel)
        return self[channel]


class Schedule:
    """Schedule of one flight. Call `advance` whenever something may have arrived.

    Attributes:
        now: stamp of the present step [ns].
        index: number of steps completed.
        names: names of the participants, in the order in which they work within a step.
    """

    def __init__(self, vehicle: Component[Any], participants: Iterable[Participant], tasks: Mapping[str, Task],
                 codec: Codec | None = None) -> None:
        """
        Args:
            vehicle: component that owns the time, a `Vehicle`.
            participants: participants from the beginning.
            tasks: tasks of all possible participants, in the order in which they work within a step.
            codec: codec of the vehicle's packets; None: they never leave this process.

        Raises:
            PerchError: a participant has no task.
        """
        self.now, self.index = 0, 0
        self._vehicle = cast(Vehicle, vehicle)
        self._vehicle_receivers = {channel: packet_receiver(vehicle, handle) for channel, handle in handlers(vehicle).items()}
        self._emissions = Emissions(vehicle, codec)
        self._slots = {name: Slot(name, task) for name, task in tasks.items()}
        self._fast = [slot for slot in self._slots.values() if slot.task.latency is None]
        self._slow = [slot for slot in self._slots.values() if slot.task.latency is not None]
        self._latest: dict[str, list[Packet]] = {}
        self._pending_images: dict[str, deque[CameraImage]] = {}
        self._awaited: Slot | None = None  # fast participant whose answer is missing
        self._routes = _Routes(self._receivers)
        self.names: list[str] = []
        for participant in participants:
            self.join(participant)
        self._steps = self._flight()

    # -- participants ------------------------------------------------------------------------------------------------

    def join(self, participant: Participant) -> None:
        """Add a participant, or replace the one of the same name, whose pending results are discarded.

        It receives the latest packet of each latched channel; a fast one whose answer is awaited receives the present batch, too.

        Raises:
            PerchError: there is no task for its name.
        """
        if participant.name not in self._slots:
            raise PerchError(f"{participant.name!r} is not one of {', '.join(self._slots)}")
        self.drop(participant.name)
        slot = self._slots[participant.name]
        slot.participant, slot.last = participant, self.index
        for channel in sorted(self._latest):
            if channel in participant.inputs:
                slot.inbox += self._latest[channel]
        self._reroute()

    def drop(self, name: str) -> None:
        """Remove a participant, and discard its pending results."""
        slot = self._slots[name]
        slot.participant = None
        for queue in (slot.inbox, slot.pending, slot.done):
            queue.clear()
        self._reroute()

    def _reroute(self) -> None:
        self._routes.clear()
        self.names = [name for name, slot in self._slots.items() if slot.participant is not None]
        taken = {channel for slot in self._slots.values() for channel in slot.inputs}
        taken |= set(self._vehicle_receivers)

        def is_taken(channel: str) -> bool:
            return channel in taken or _is_latched(channel)

        self._emissions.set_channel_filter(is_taken)
        for slot in self._slots.values():
            if slot.participant is not None:
                slot.participant.set_channel_filter(is_taken)

    def _receivers(self, channel: str) -> list[Callable[[Packet], None]]:
        receivers: list[Callable[[Packet], None]] = [
            slot.inbox.append for slot in self._slots.values() if channel in slot.inputs]
        if channel in self._vehicle_receivers:
            receivers.append(self._vehicle_receivers[channel])
        if _is_latched(channel):
            receivers.append(self._latch)
        return receivers

    def _latch(self, packet: Packet) -> None:
        latched = self._latest.setdefault(packet.channel, [])
        if packet.channel != "/tf_static":  # one transform each: all are kept
            latched.clear()
        latched.append(packet)

    # -- stepping ----------------------------------------------------------------------------------------------------

    def advance(self) -> bool:
        """Continue the flight, by at most one control period.

        Returns:
            True: a control period has been completed. False: something is `pending`; call again when it may have arrived.
        """
        for slot in self._slow:
            if slot.pending:
                self._work(slot)
        return next(self._steps)

    def pending(self) -> list[PendingInput]:
        """Return what the flight waits for, after `advance` has returned False."""
        if self._awaited is not None:
            return [PendingInput(self._awaited.name, "its answer to the present step", self.now)]
        missing = [PendingInput(f"camera_{camera}", "an image", images[0].stamp)
                   for camera, images in self._pending_images.items() if len(images) > MAX_PENDING_IMAGES]
        for slot in self._slow:
            if slot.pending and slot.pending[0].due <= self.now:
                batch = slot.pending[0]
                image = None if batch.begun else first_pending_image(batch)
                missing.append(PendingInput(slot.name, "its results", batch.stamp) if image is None
                               else PendingInput(image.channel.split("/")[0], f"an image for {slot.name}", image.value.stamp))
        return missing

    def await_image(self, timeout: float) -> bool:
        """Wait for an image without which the flight cannot continue; return False if there is none.

        Args:
            timeout: longest wait [s].
        """
        for images in self._pending_images.values():
            if len(images) > MAX_PENDING_IMAGES:
                is_rendered(images[0], timeout)
                return True
        for slot in self._slow:
            if slot.pending and slot.pending[0].due <= self.now and not slot.pending[0].begun:
                image = first_pending_image(slot.pending[0])
                if image is not None:
                    is_rendered(image.value, timeout)
                    return True
        return False

    def _flight(self) -> Iterator[bool]:
        """Run the flight; yield True after each control period, and False where it has to wait."""
        routes, vehicle, emissions = self._routes, self._vehicle, self._emissions
        while True:
            arrivals = vehicle.advance()
            now = self.now = vehicle.time
            packets = emissions.take()
            if arrivals:
                self._note_images(arrivals)
                while self._rendering_behind():
                    yield False
            released: list[Packet] = []
            for slot in self._slow:
                while True:
                    while slot.done and slot.done[0].due <= now:
                        released += slot.done.popleft().results
                    if not slot.pending or slot.pending[0].due > now:
                        break
                    yield False
            if len(released) > 1:
                released.sort(key=_CHANNEL)
            for packet in released:
                for take in routes[packet.channel]:
                    take(packet)
            for packet in packets:
                for take in routes[packet.channel]:
                    take(packet)
            for slot in self._fast:
                if slot.participant is None:
                    continue
                worker, batch = slot.participant, slot.inbox.copy()
                slot.inbox.clear()
                worker.begin(now, batch)
                results = worker.results()
                while results is None:
                    self._awaited = slot
                    yield False
                    if slot.participant is not worker:
                        if slot.participant is None:
                            break
                        worker, batch = slot.participant, slot.inbox + batch
                        slot.inbox.clear()
                        worker.begin(now, batch)
                    results = worker.results()
                self._awaited = None
                for packet in results or ():
                    for take in routes[packet.channel]:
                        take(packet)
            self._trigger(now, arrivals)
            self.index += 1
            yield True

    # -- slow participants -------------------------------------------------------------------------------------------

    def _trigger(self, now: int, arrivals: Sequence[Arrival]) -> None:
        """Close the batches of slow participants whose work begins at this step."""
        for slot in self._slow:
            if slot.participant is None:
                continue
            due = None
            if slot.task.period:
                if self.index % slot.task.period == 0:
                    due = now + slot.latency
            elif arrivals:
                due = max((arrival.middle + slot.latency for arrival in arrivals if slot.is_triggered_by(arrival)), default=None)
            if due is None:
                if slot.task.period or self.index - slot.last < MAX_STEPS_WITHOUT_FRAME:
                    continue
                due = now + slot.latency
            slot.last = self.index
            slot.pending.append(Batch(now, max(due, now + CONTROL_PERIOD_NS), slot.inbox.copy()))
            slot.inbox.clear()
            self._work(slot)

    def _work(self, slot: Slot) -> None:
        """Collect results and begin batches in order, as far as possible."""
        pending, participant = slot.pending, slot.participant
        assert participant is not None  # an empty slot has no batches
        while pending:
            batch = pending[0]
            if not batch.begun:
                if slot.takes_images:
                    if first_pending_image(batch) is not None:
                        return
                    lost = [packet for packet in batch.packets if is_lost(packet)]
                    if lost:  # there will be no result; the rest of the batch is merged with the next one
                        pending.popleft()
                        after = pending[0].packets if pending else slot.inbox
                        after[:0] = [packet for packet in batch.packets if packet not in lost]
                        continue
                batch.begun = True
                participant.begin(batch.stamp, batch.packets)
            results = participant.results()
            if results is None:
                return
            batch.results = results
            slot.done.append(pending.popleft())

    # -- images ------------------------------------------------------------------------------------------------------

    def _note_images(self, arrivals: Sequence[Arrival]) -> None:
        for arrival in arrivals:
            if arrival.image is not None and arrival.image.ready is not None:
                self._pending_images.setdefault(arrival.camera, deque()).append(arrival.image)

    def _rendering_behind(self) -> bool:
        """Return whether frames arrive faster than they are rendered: then the flight waits, even if no participant does."""
        behind = False
        for images in self._pending_images.values():
            while images and is_rendered(images[0]):
                images.popleft()
            behind = behind or len(images) > MAX_PENDING_IMAGES
        return behind


def _is_latched(channel: str) -> bool:
    return channel in LATCHED or channel.endswith("/camera_info")
