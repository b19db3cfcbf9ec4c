"""Who takes part in the lockstep: what starts each slow participant's work, and when its result counts."""

from __future__ import annotations

from dataclasses import dataclass

from perch_core.errors import ConfigError
from perch_core.scenario import Latency

CONTROLLER = "controller"  # answers within the step; all others are slow participants


@dataclass(frozen=True)
class Trigger:
    """What starts a participant's work.

    Attributes:
        node: name of the participant.
        latency: from the trigger's time to when the result counts [s].
        camera: the trigger is a frame of this camera and its time the middle of the exposure; None: a tick.
        needs_image: the frame counts only where an image is taken, not just its camera_info.
        period: steps between two ticks.
    """

    node: str
    latency: float
    camera: str | None = None
    needs_image: bool = True
    period: int = 0

    @property
    def topic(self) -> str:
        """The topic that carries the trigger."""
        if self.camera is None:
            return "tick"
        return f"camera_{self.camera}/{'image_raw' if self.needs_image else 'camera_info'}"


def triggers(names: tuple[str, ...], latency: Latency) -> tuple[Trigger, ...]:
    """The triggers of the slow participants among `names`, the controller apart.

    The recorder writes every 0.1 s of flight within 0.1 s, so that the flight cannot outrun the disk.

    Raises:
        ConfigError: a name is not one of those that can take part.
    """
    known = {trigger.node: trigger for trigger in (
        Trigger("vio", latency.vio, camera="down"),
        Trigger("vio_model", latency.vio, camera="down", needs_image=False),
        Trigger("target_localizer", latency.target_localizer, camera="front"),
        Trigger("powerline_mapper", latency.powerline_mapper, camera="front"),
        Trigger("mission", latency.mission, period=10),
        Trigger("recorder", 0.1, period=50),
    )}
    for name in names:
        if name not in known and name != CONTROLLER:
            raise ConfigError("vehicle", "participants", f"{name!r} is not one of {', '.join((CONTROLLER, *known))}")
    return tuple(known[name] for name in names if name != CONTROLLER)
