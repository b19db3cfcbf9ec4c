"""Camera frames that have arrived in lockstep, and whose images may still be being drawn."""

from __future__ import annotations

from collections.abc import Collection, Mapping

from perch_core.timing import CONTROL_PERIOD_NS
from perch_sim.camera_stream import CameraStream, Delivery
from perch_sim.participants import Trigger
from perch_sim.ros.lockstep_watch import LockstepWatch

MOST_UNDRAWN = 2     # frames per camera that have arrived before their images
DRAWING_WAIT = 0.02  # for an image without which nobody can go on; then the next look after the flight [s]


class Arrivals:
    """Frames trigger their users' work as they arrive; their images follow when they are drawn.

    It is the results of that work that have a time: until the first of them is due nobody waits for an image.
    """

    def __init__(self, cameras: Mapping[str, CameraStream], watch: LockstepWatch) -> None:
        self._cameras, self._watch = cameras, watch
        self._undrawn: list[tuple[str, Delivery]] = []  # oldest first

    def take(self, stamp: int) -> list[str]:
        """Trigger the work that begins with the frames that arrive at a step [ns]; the cameras that they come from."""
        names = [name for name, camera in self._cameras.items() if camera.due(stamp) is not None]
        for name in names:
            delivery = self._cameras[name].take()
            self._undrawn.append((name, delivery))
            for trigger in self._triggered_by(name, delivery):
                due = max(delivery.frame.middle + round(trigger.latency * 1e9), stamp + CONTROL_PERIOD_NS)
                self._watch.trigger(trigger.node, delivery.frame.stamp, due)
        return names

    def crowded(self) -> set[str]:
        """Cameras whose frames arrive faster than they are drawn: the flight waits for them even where nobody else does."""
        names = [name for name, _ in self._undrawn]
        return {name for name in names if names.count(name) > MOST_UNDRAWN}

    def drawn(self, awaited: Collection[str | None] = ()) -> list[tuple[str, Delivery]]:
        """Frames whose image has been drawn, each camera's in order; waits a moment for one of a camera that is awaited."""
        drawn, coming, behind = [], [], set()
        for name, delivery in self._undrawn:
            if name in behind or not (delivery.image is None or delivery.image.done(DRAWING_WAIT if name in awaited else 0.0)):
                behind.add(name)
                coming.append((name, delivery))
            else:
                drawn.append((name, delivery))
        self._undrawn = coming
        for name, delivery in drawn:
            if delivery.image is not None and delivery.image.result() is None:
                for trigger in self._triggered_by(name, delivery):
                    if trigger.needs_image:
                        self._watch.cancel(trigger.node, delivery.frame.stamp)
                self._cameras[name].give_up()
        return drawn

    def _triggered_by(self, name: str, delivery: Delivery) -> list[Trigger]:
        return [trigger for trigger in self._watch.triggers
                if trigger.camera == name and (delivery.image is not None or not trigger.needs_image)]
