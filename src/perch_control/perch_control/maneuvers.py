"""Transitions between the modes of a flight, each a function from one state to the next.

| manoeuvre | mode after it | reference | why |
| --- | --- | --- | --- |
| `tracked` | TRACKING, or RECOVERING by a planned way out | the trajectory | its start time; a planned way out begins |
| `stopped` | HOVERING; RECOVERING where tilted, turning or at a surface | a brake | its end, abort, HOVER, geofence, no VIO |
| `hover_after_jump` | as `stopped`; RECOVERING stays | a hover at the new position | odometry has jumped permanently |
| `recovered` | RECOVERING | guidance by the state | off the plan, contact missed, departure |
| `hover_after_recovery` | HOVERING | a brake from the state | a recovery has come to rest |
| `land_on_command` | as `landing`; RECOVERING where `stopped` recovers | as `landing` or `recovered` | LAND |
| `landing` | LANDING | a brake into a descent | geofence, rotors at their limit, no order for too long |
| `landing_weak` | LANDING | guidance by the state | weak rotors |
| `descending` | LANDING, `blind` | none | no position |
| `attached` | ATTACHED | a hold at the place | command of the mission: the surface holds the vehicle |
| `motors_off` | DISARMED, FAILED | none | on the ground, killed, neither odometry nor IMU |
"""

from __future__ import annotations

from collections.abc import Iterable
from math import dist

from perch_core.vector3 import axes_of, norm
from perch_core.vehicle import ControlGains, Vehicle
from perch_control.admission import AtEnd, Order
from perch_control.descent import BlindDescent
from perch_control.flight_state import FlightState
from perch_control.guidance import Hold, brake
from perch_control.modes import State
from perch_control.monitors import TILT_MARGIN, reference_tilt_deg
from perch_control.recovery import Recovery
from perch_control.reference import Setpoint, Source
from perch_control.weak_landing import WeakLanding

_FOLLOWED = 0.3       # nearer to the reference than this, a manoeuvre continues the reference, not the state [m]
_LEVEL = 0.8          # cosine of the tilt up to which a brake starts from the attitude as it is
_TURNING = 4.0        # the same for the body rate [rad/s]
_ZERO = (0.0, 0.0, 0.0)


def entered(x: FlightState, mode: State, message: str) -> FlightState:
    """Enter a mode, with the reason. The order is kept while TRACKING; the planned contact also while RECOVERING."""
    return x._replace(mode=mode, message=message, events=(*x.events, message), order=x.order if mode is State.TRACKING else None,
                      land_requested=x.land_requested and mode in (State.TRACKING, State.RECOVERING, State.HOVERING),
                      left_early=False,
                      planned_contact=x.planned_contact if mode in (State.TRACKING, State.RECOVERING) else None)


def following(x: FlightState, source: Source) -> FlightState:
    """Follow a reference from the present time on."""
    return x._replace(source=source, start=x.now)


def tracked(x: FlightState, order: Order, source: Source, leaving: str = "") -> FlightState:
    """Follow a trajectory by the reference made from it; `leaving`: why it is flown, if it is a planned way out."""
    x = (entered(x, State.RECOVERING, f"recovering as planned: {leaving}") if leaving else
         entered(x, State.TRACKING, f"tracking trajectory {order.id}"))
    contact = {AtEnd.CONTACT: order.source.duration, AtEnd.RECOVER: order.recovery_start}.get(order.at_end, -1.0)
    # A way out keeps the contact of its trajectory: it leads to no other one.
    planned_contact = (order.start + contact, order.source.setpoint(contact).p) if contact >= 0.0 else x.planned_contact
    return x._replace(attached_to=None, airborne=x.airborne or x.attached_to is not None, order=order, source=source,
                      start=order.start, trajectory_id=order.id, planned_contact=planned_contact)


def motors_off(x: FlightState, mode: State, message: str) -> FlightState:
    """Stop the motors."""
    return entered(x, mode, message)._replace(blind=None, trajectory_id=0, airborne=False, rotors=x.rotors.turning(0.0))


def attached(x: FlightState, message: str) -> FlightState:
    """Stop the motors on a surface that carries the vehicle, and keep the place as reference."""
    _, b2, b3 = axes_of(x.state_estimate[6:10])
    place = following(motors_off(x, State.ATTACHED, message), Hold.at(x.state_estimate[0:3], b2))
    return place._replace(attached_to=x.surface_normal or b3)


def stopped(x: FlightState, message: str) -> FlightState:
    """Brake to a hover; by a recovery where the vehicle is tilted, turning, off the reference's tilt, or at a surface."""
    setpoint = x.setpoint()
    _, _, b3 = axes_of(x.state_estimate[6:10])
    turning = b3[2] < _LEVEL or norm(x.state_estimate[10:13]) > _TURNING
    if turning or x.surface_normal or reference_tilt_deg(x.state_estimate, setpoint) > TILT_MARGIN:
        return recovered(x, message)
    p, v, a = _initial_motion(x, setpoint)
    left_early = x.left_early or (x.order is not None and x.elapsed < x.order.source.duration)
    return following(entered(x, State.HOVERING, message)._replace(left_early=left_early),
                     brake(p, v, a, setpoint.h, within=x.stopping[0]))


def hover_after_jump(x: FlightState, message: str) -> FlightState:
    """Hover at the position after a jump of the odometry, as the reference is invalid. A landing or recovery is continued."""
    x = x._replace(land_requested=x.land_requested or x.mode is State.LANDING)
    if isinstance(x.source, Recovery):
        return entered(x, State.RECOVERING, f"recovering: {message}")._replace(source=x.source.moved(x.state_estimate[0:3]))
    if x.surface_normal:
        return recovered(x, message)
    return stopped(following(x, Hold.at(x.state_estimate[0:3], axes_of(x.state_estimate[6:10])[1])), message)


def hover_after_recovery(x: FlightState, message: str) -> FlightState:
    """Hover after a recovery, from the state as it is."""
    state = x.state_estimate
    return following(entered(x, State.HOVERING, message), brake(state[0:3], state[3:6], _ZERO, axes_of(state[6:10])[1]))


def recovered(x: FlightState, message: str) -> FlightState:
    """Return to a hover from any attitude; from a surface, push off first."""
    guidance = Recovery(x.specific_thrust_max, x.state_estimate, x.surface_normal or x.attached_to)
    return following(entered(x, State.RECOVERING, f"recovering: {message}"), guidance)._replace(
        attached_to=None, airborne=x.airborne or x.attached_to is not None)


def landing(x: FlightState, message: str, speed: float) -> FlightState:
    """Descend with a speed [m/s] until ground contact; a landing continues: repeated, its brake would never act."""
    if x.mode is State.LANDING:
        return x._replace(message=message)
    setpoint = x.setpoint()
    p, v, a = _initial_motion(x, setpoint)
    return following(entered(x, State.LANDING, message), brake(p, v, a, setpoint.h, (0.0, 0.0, -speed), x.stopping[0]))


def land_on_command(x: FlightState, message: str, speed: float) -> FlightState:
    """Land with a speed [m/s]; where a hover would begin with a recovery, land after it."""
    after = x if x.mode in (State.LANDING, State.RECOVERING) else stopped(x, message)
    return after._replace(message=message, land_requested=True) if after.mode is State.RECOVERING else landing(x, message, speed)


def landing_weak(x: FlightState, message: str, speed: float) -> FlightState:
    """Land at once with a speed [m/s], with the remaining thrust."""
    guidance = WeakLanding(speed, x.state_estimate, x.ground)
    guidance.update(x.state_estimate, x.specific_thrust_max)
    return following(entered(x, State.LANDING, f"landing on weak rotors: {message}"), guidance)


def descending(x: FlightState, message: str, vehicle: Vehicle, gains: ControlGains,
               imu_since_odometry: Iterable[tuple[float, tuple[float, ...], tuple[float, ...]]],
               moving: bool = True) -> FlightState:
    """Descend without position: level, with a little less thrust than the weight.

    Args:
        x: state of the flight.
        message: why.
        vehicle: model with the thrust observed in flight.
        gains: attitude gains.
        imu_since_odometry: IMU samples since the last accepted odometry: time [s], rates [rad/s], specific force [m/s^2]. The
            descent starts from that odometry, as the IMU is more accurate than the prediction since then.
        moving: whether the last velocity is trusted.
    """
    stamp, state = x.last_odometry
    blind = BlindDescent(vehicle, gains, state[6:10], state[10:13], stamp, x.now, state[3:6] if moving else _ZERO)
    for sample in imu_since_odometry:
        blind.imu(*sample)
    return entered(x, State.LANDING, f"descent without position: {message}")._replace(blind=blind)


def _initial_motion(x: FlightState, setpoint: Setpoint) -> tuple:
    """Position, velocity and acceleration at which a manoeuvre starts: those of the reference where the vehicle follows it, so
    that the reference does not jump; otherwise those of the state, without acceleration."""
    near = dist(setpoint.p, x.state_estimate[0:3]) < _FOLLOWED
    if near and (x.order is not None or x.mode is State.HOVERING):
        return setpoint.p, setpoint.v, setpoint.a
    return x.state_estimate[0:3], x.state_estimate[3:6], _ZERO
