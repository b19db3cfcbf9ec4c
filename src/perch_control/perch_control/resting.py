"""A vehicle at rest, on the ground or on its perch: whether its motors may start, and for how long they idle."""

from __future__ import annotations

from math import cos, radians

from perch_core.vector3 import axes_of, norm
from perch_core.vehicle import GRAVITY
from perch_control.flight_state import FlightState
from perch_control.maneuvers import motors_off
from perch_control.modes import CommandRefused, State
from perch_control.sensor_inputs import SensorInputs

_IDLE_TIME = 10.0               # armed on the ground without a trajectory for so long: motors off [s]
_ARM_TILT = cos(radians(45.0))  # of the largest tilt at which motors start and idle on the ground
_ARM_SPEED = 0.5                # largest speed there [m/s]
_ARM_FORCE_MIN = 0.5 * GRAVITY  # smallest specific force along b3 there [m/s^2]
_STEEP, _UPRIGHT = cos(radians(60.0)), cos(radians(30.0))  # of a perch, and of a vehicle that was taken down from it
_FALLEN = 0.5                   # at rest so far below the place of ATTACHED, nothing there carries the vehicle [m]
_FALLING = 1.0                  # faster than this it is still falling, and the motors may save it [m/s]


def check_arming(x: FlightState, inputs: SensorInputs, specific_thrust: float, timeout: float) -> None:
    """Check whether the motors may start.

    Args:
        x: state of the vehicle, whose motors are off.
        inputs: its sensors.
        specific_thrust: last measured specific force along b3 [m/s^2].
        timeout: largest age of odometry and IMU samples [s].

    Raises:
        CommandRefused: they may not.
    """
    if x.mode not in (State.DISARMED, State.ATTACHED):
        raise CommandRefused(f"arm is refused: {x.mode.name.lower()}; disarm first")
    if inputs.age > timeout:
        raise CommandRefused("arm is refused: no usable odometry" + (f" ({inputs.refusal})" if inputs.refusal else ""))
    if inputs.imu_age(x.now) > timeout:
        raise CommandRefused("arm is refused: no usable IMU samples")
    if x.mode is State.DISARMED and (problem := _unsafe(x)):
        raise CommandRefused(f"arm is refused: {problem}")
    if problem := off_perch(x):
        raise CommandRefused(f"arm is refused: {problem}")
    if x.mode is State.DISARMED and specific_thrust < _ARM_FORCE_MIN:
        raise CommandRefused(f"arm is refused: the IMU measures {specific_thrust:.1f} m/s^2 along b3 at rest: its axes are configured wrongly")


def off_perch(x: FlightState) -> str:
    """Return why an attached vehicle is not held by its perch any more; empty: it may be held.

    It lies below its perch, where only its height counts: the surface may carry it sideways, a wire lets it swing. Odometry that begins
    anew at a lower height looks the same, as does a fall while odometry was lost: only people can tell. Or it stands upright, which
    nothing holds on a steep surface or wire: somebody has taken it off.
    """
    if x.mode is not State.ATTACHED:
        return ""
    speed, tilt = norm(x.state_estimate[3:6]), axes_of(x.state_estimate[6:10])[2][2]
    if x.setpoint().p[2] - x.state_estimate[2] > _FALLEN and speed < _FALLING:
        return ("the vehicle has come off and lies below its perch: disarm first; if it is still held, and the surface has carried it down or "
                "odometry has begun anew: command ATTACHED again")
    if x.attached_to is not None and x.attached_to[2] < _STEEP and tilt > _UPRIGHT and speed < _ARM_SPEED:
        return "the vehicle stands upright, off its perch; disarm first"
    return ""


def idling(x: FlightState, waiting: bool) -> FlightState:
    """Stop the motors where they idle in vain, or where the vehicle is tilted or moved; `waiting`: whether a trajectory is pending."""
    if x.mode is State.ARMED and not waiting and x.elapsed > _IDLE_TIME:
        x = motors_off(x, State.DISARMED, f"disarmed: no trajectory for {_IDLE_TIME:g} s")
    if x.mode is State.ARMED and (problem := _unsafe(x)):
        x = motors_off(x, State.DISARMED, f"disarmed: {problem}")
    return x


def _unsafe(x: FlightState) -> str:
    """Return why motors may not run on the ground: the vehicle is tilted, or somebody carries it; empty: they may."""
    if axes_of(x.state_estimate[6:10])[2][2] < _ARM_TILT:
        return "the vehicle is tilted by more than 45 deg"
    speed = norm(x.state_estimate[3:6])
    return f"the vehicle moves with {speed:.1f} m/s" if speed > _ARM_SPEED else ""
