"""Command to the rotors that follows from the state of a flight. Each function returns the state after it, and the result of the step."""

from __future__ import annotations

from math import dist

from perch_control.descent import BlindDescent
from perch_control.flight_state import FlightState
from perch_control.inner_loop import DelayedReference
from perch_control.l1 import L1Augmentation
from perch_control.law import NO_COMPENSATION, Law
from perch_control.modes import State, StepResult
from perch_control.period import NOMINAL_PERIOD
from perch_control.recovery import Recovery
from perch_control.reference import Setpoint

_SPARE_SHARE = 0.01           # weight of a step of 2 ms in the mean margin: 0.2 s
_UNKNOWN_MOTION = (0.0,) * 6  # position and velocity in a descent without position
_AT_REST = (0.0,) * 9 + (1.0, 0.0, 0.0, 0.0)


def fly(x: FlightState, setpoint: Setpoint, law: Law, compensator: L1Augmentation | None, period: float) -> tuple[FlightState, StepResult]:
    """Follow the running reference.

    Args:
        x: state of the flight.
        setpoint: of the reference at this step.
        law: control law.
        compensator: L1 augmentation; None: without L1.
        period: control period [s].
    """
    contact = x.time_to_contact
    state, delay = x.rotors.ahead(x.state_estimate, x.vehicle), x.rotors.delay
    reference = DelayedReference(x, delay) if delay > 0.0 else x
    compensation = NO_COMPENSATION if compensator is None else _compensation(x, compensator, contact)
    out = law.control(state, reference, x.rotors.at_effect, compensation, max(contact - delay, 0.0))
    rotors = x.rotors.following(out.rotor_speed, state, x.vehicle, out.w_C)
    top = x.vehicle.thrust_max
    margin, spare = (top - max(out.rotor_thrust)) / top, x.spare
    if x.mode is State.HOVERING:
        spare += _SPARE_SHARE * (period / NOMINAL_PERIOD) * (margin - spare)
    x = x.commanded(rotors, margin, spare, dist(setpoint.p, x.state_estimate[0:3]))
    return x, StepResult(True, out.rotor_speed, setpoint, out.q_C, out.w_C, out.dw_C, out.wrench, margin, "; ".join(x.events), rotors.sent)


def _compensation(x: FlightState, compensator: L1Augmentation, contact: float) -> tuple[float, ...]:
    """Return the compensation of disturbances; forces of the ground or of a wall must not be estimated as disturbances."""
    if x.at_ground or isinstance(x.source, Recovery):  # what a recovery follows, an impact or a blow, is in the estimate
        compensator.reset()
        return NO_COMPENSATION
    if x.mode in (State.LANDING, State.RECOVERING) or contact <= 0.0 or x.may_touch(0.0):
        return compensator.hold()
    return compensator.update(x.state_estimate, x.rotors.speed, x.now)


def descend(x: FlightState, blind: BlindDescent) -> tuple[FlightState, StepResult]:
    """Descend without position."""
    speed, thrust = blind.rotors(x.rotors.at_effect.speed)
    rotors = x.rotors.following(speed, (*_UNKNOWN_MOTION, *blind.attitude.q, *blind.attitude.w), x.vehicle)
    x = x.commanded(rotors, (x.vehicle.thrust_max - max(thrust)) / x.vehicle.thrust_max, x.spare, x.position_error)
    return x, StepResult(True, speed, wrench=blind.wrench(), margin=x.margin, event="; ".join(x.events), loop=rotors.sent)


def rest(x: FlightState) -> tuple[FlightState, StepResult]:
    """Idle on the ground, or keep the motors off."""
    armed = x.mode is State.ARMED
    speed = (x.vehicle.speed_min,) * 4 if armed else (0.0,) * 4
    rotors = x.rotors.following(speed, x.state_estimate or _AT_REST, x.vehicle)
    return x.commanded(rotors, 1.0, x.spare, 0.0), StepResult(armed, speed, event="; ".join(x.events), loop=rotors.sent)
