"""States of the controller, with the values of the messages, and the result of a control step."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple

from perch_control.inner_loop import LoopCommand
from perch_control.reference import Setpoint
from perch_core.errors import PerchError


class State(IntEnum):
    """State of the controller, as in `perch_msgs/ControllerStatus`."""

    DISARMED = 0
    ARMED = 1
    TRACKING = 2
    HOVERING = 3
    RECOVERING = 4
    LANDING = 5
    FAILED = 6
    ATTACHED = 7


FLYING = (State.TRACKING, State.HOVERING, State.RECOVERING, State.LANDING)


class CommandRefused(PerchError):
    """Raised when a command is not carried out; the message gives the reason."""


class StepResult(NamedTuple):
    """Result of one control step.

    Attributes:
        armed: whether the motors run.
        rotor_speed: commanded speeds [rad/s], 4 floats.
        setpoint: reference at this step; None while the motors are off or idle, and in a descent without position.
        q_C, w_C, dw_C: commanded attitude (xyzw), body rates [rad/s], angular acceleration [rad/s^2].
        wrench: wanted thrust [N] and moments [N m], 4 floats.
        margin: (max - commanded) / max of the most loaded rotor.
        event: events of this step, for the log; empty: none.
        loop: command to the vehicle's inner loop; None: the vehicle takes rotor speeds.
    """

    armed: bool
    rotor_speed: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    setpoint: Setpoint | None = None
    q_C: tuple[float, ...] = (0.0, 0.0, 0.0, 1.0)
    w_C: tuple[float, ...] = (0.0, 0.0, 0.0)
    dw_C: tuple[float, ...] = (0.0, 0.0, 0.0)
    wrench: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0)
    margin: float = 1.0
    event: str = ""
    loop: LoopCommand | None = None
