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
from perch_sim.lockstep.batches import Arrival, Batch, Place, first_undrawn, is_drawn, is_lost
from perch_sim.lockstep.packet import Codec, Packet
from perch_sim.lockstep.participant import Emissions, Participant, handlers
from perch_sim.lockstep.tasks import Task
from perch_sim.timing import CONTROL_PERIOD_NS

MOST_UNDRAWN = 2            # frames of a camera that have arrived before their images
LONGEST_SILENCE = 500       # steps without a frame after which a participant gets what has come to it all the same
LATCHED = ("/tf_static", "target/pose", "powerlines", "ground_truth/target")
_CHANNEL = attrgetter("channel")


class Owed(NamedTuple):
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
        self._vehicle_handlers = handlers(vehicle)
        self._emissions = Emissions(vehicle, codec)
        self._places = {name: Place(name, task) for name, task in tasks.items()}
        self._fast = [place for place in self._places.values() if place.task.latency is None]
        self._slow = [place for place in self._places.values() if place.task.latency is not None]
        self._latest: dict[str, list[Packet]] = {}
        self._undrawn: dict[str, deque[CameraImage]] = {}
        self._awaited: Place | None = None  # fast participant whose answer is missing
        self._routes = _Routes(self._takers)
        for participant in participants:
            self.join(participant)
        self._steps = self._flight()

    # -- who takes part ----------------------------------------------------------------------------------------------

    @property
    def names(self) -> list[str]:
        """Names of the participants, in the order in which they work within a step."""
        return [name for name, place in self._places.items() if place.participant is not None]

    def join(self, participant: Participant) -> None:
        """Add a participant, or replace the one of the same name, whose pending results are discarded.

        It receives the latest packet of each latched channel; a fast one whose answer is awaited receives the present batch, too.

        Raises:
            PerchError: there is no task for its name.
        """
        if participant.name not in self._places:
            raise PerchError(f"{participant.name!r} is not one of {', '.join(self._places)}")
        self.drop(participant.name)
        place = self._places[participant.name]
        place.participant, place.last = participant, self.index
        for channel in sorted(self._latest):
            if channel in participant.inputs:
                place.inbox += self._latest[channel]
        self._reroute()

    def drop(self, name: str) -> None:
        """Remove a participant, and discard its pending results."""
        place = self._places[name]
        place.participant = None
        for queue in (place.inbox, place.coming, place.done):
            queue.clear()
        self._reroute()

    def _reroute(self) -> None:
        self._routes.clear()
        taken = {channel for place in self._places.values() for channel in place.inputs}
        taken |= set(self._vehicle_handlers)

        def is_taken(channel: str) -> bool:
            return channel in taken or _is_latched(channel)

        self._emissions.listen(is_taken)
        for place in self._places.values():
            if place.participant is not None:
                place.participant.listen(is_taken)

    def _takers(self, channel: str) -> list[Callable[[Packet], None]]:
        takers: list[Callable[[Packet], None]] = [
            place.inbox.append for place in self._places.values() if channel in place.inputs]
        if channel in self._vehicle_handlers:
            handle = self._vehicle_handlers[channel]
            takers.append(lambda packet: handle(packet.value))
        if _is_latched(channel):
            takers.append(self._keep)
        return takers

    def _keep(self, packet: Packet) -> None:
        kept = self._latest.setdefault(packet.channel, [])
        if packet.channel != "/tf_static":  # one transform each: all of them count
            kept.clear()
        kept.append(packet)

    # -- going on ----------------------------------------------------------------------------------------------------

    def advance(self) -> bool:
        """Continue the flight, by at most one control period.

        Returns:
            True: a control period has been completed. False: something is `owed`; call again when it may have arrived.
        """
        for place in self._slow:
            if place.coming:
                self._work(place)
        return next(self._steps)

    def owed(self) -> list[Owed]:
        """Return what the flight waits for, after `advance` has returned False."""
        if self._awaited is not None:
            return [Owed(self._awaited.name, "its answer to the present step", self.now)]
        missing = [Owed(f"camera_{camera}", "an image", images[0].stamp)
                   for camera, images in self._undrawn.items() if len(images) > MOST_UNDRAWN]
        for place in self._slow:
            if place.coming and place.coming[0].due <= self.now:
                batch = place.coming[0]
                image = None if batch.begun else first_undrawn(batch)
                missing.append(Owed(place.name, "its results", batch.stamp) if image is None
                               else Owed(image.channel.split("/")[0], f"an image for {place.name}", image.value.stamp))
        return missing

    def await_image(self, timeout: float) -> bool:
        """Wait for an image without which the flight cannot continue; return False if there is none.

        Args:
            timeout: longest wait [s].
        """
        for images in self._undrawn.values():
            if len(images) > MOST_UNDRAWN:
                is_drawn(images[0], timeout)
                return True
        for place in self._slow:
            if place.coming and place.coming[0].due <= self.now and not place.coming[0].begun:
                image = first_undrawn(place.coming[0])
                if image is not None:
                    is_drawn(image.value, timeout)
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
                while self._crowded():
                    yield False
            released: list[Packet] = []
            for place in self._slow:
                while True:
                    while place.done and place.done[0].due <= now:
                        released += place.done.popleft().results
                    if not place.coming or place.coming[0].due > now:
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
            for place in self._fast:
                if place.participant is None:
                    continue
                worker, batch = place.participant, place.inbox.copy()
                place.inbox.clear()
                worker.begin(now, batch)
                results = worker.results()
                while results is None:
                    self._awaited = place
                    yield False
                    if place.participant is not worker:
                        if place.participant is None:
                            break
                        worker, batch = place.participant, place.inbox + batch
                        place.inbox.clear()
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
        for place in self._slow:
            if place.participant is None:
                continue
            due = None
            if place.task.period:
                if self.index % place.task.period == 0:
                    due = now + place.latency
            elif arrivals:
                due = max((arrival.middle + place.latency for arrival in arrivals if place.awaits(arrival)), default=None)
            if due is None:
                if place.task.period or self.index - place.last < LONGEST_SILENCE:
                    continue
                due = now + place.latency
            place.last = self.index
            place.coming.append(Batch(now, max(due, now + CONTROL_PERIOD_NS), place.inbox.copy()))
            place.inbox.clear()
            self._work(place)

    def _work(self, place: Place) -> None:
        """Collect results and begin batches in order, as far as possible."""
        coming, participant = place.coming, place.participant
        assert participant is not None  # an empty place has no batches
        while coming:
            batch = coming[0]
            if not batch.begun:
                if place.takes_images:
                    if first_undrawn(batch) is not None:
                        return
                    lost = [packet for packet in batch.packets if is_lost(packet)]
                    if lost:  # nothing comes of it; the rest of the batch goes with the next
                        coming.popleft()
                        after = coming[0].packets if coming else place.inbox
                        after[:0] = [packet for packet in batch.packets if packet not in lost]
                        continue
                batch.begun = True
                participant.begin(batch.stamp, batch.packets)
            results = participant.results()
            if results is None:
                return
            batch.results = results
            place.done.append(coming.popleft())

    # -- images ------------------------------------------------------------------------------------------------------

    def _note_images(self, arrivals: Sequence[Arrival]) -> None:
        for arrival in arrivals:
            if arrival.image is not None and arrival.image.ready is not None:
                self._undrawn.setdefault(arrival.camera, deque()).append(arrival.image)

    def _crowded(self) -> bool:
        """Return whether frames arrive faster than they are rendered: then the flight waits, even if no participant does."""
        crowded = False
        for images in self._undrawn.values():
            while images and is_drawn(images[0]):
                images.popleft()
            crowded = crowded or len(images) > MOST_UNDRAWN
        return crowded


def _is_latched(channel: str) -> bool:
    return channel in LATCHED or channel.endswith("/camera_info")
