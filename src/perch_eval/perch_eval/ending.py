"""The end of a flight by the true situation of the vehicle; a hover also requires the controller's state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from perch_control.modes import State
from perch_eval.metrics import tilt_degrees
from perch_sim.simulation import Simulation

SAFE = ("hovering", "landed", "perched", "motors off")
"""Safe ends; `motors off`: on the ground, tilted by 20 deg or more, motors off. Not after a crash."""
MAX_HOVER_SPEED = 0.3  # [m/s]


class Situation(NamedTuple):
    """True situation of the vehicle at one time.

    Attributes:
        height: height of the centre of mass above its place before the flight [m].
        speed: [m/s].
        tilt: [deg].
        rotors: speed of the fastest rotor [rad/s].
        held: whether velcro or gripper holds the vehicle.
        hovers: whether the controller reports a hover.
    """

    height: float
    speed: float
    tilt: float
    rotors: float
    held: bool
    hovers: bool


def ending(now: Situation) -> str:
    """Return the end of a flight that has not crashed."""
    if now.held and now.speed < 0.1 and now.rotors < 50.0:
        return "perched"
    if now.rotors < 50.0 and now.height < 0.15 and now.speed < 0.1:
        return "landed" if now.tilt < 20.0 else "motors off"
    if now.hovers and now.speed < MAX_HOVER_SPEED and now.tilt < 20.0 and now.height > 0.2:
        return "hovering"
    return "held with running motors" if now.held else "on the ground with running motors" if now.height < 0.15 else "in flight"


def simulated_ending(simulation: Simulation, state: State) -> str:
    """Return the end of a flight in this process, `crashed` where the plant is broken; `state`: of the controller."""
    plant, x = simulation.plant, simulation.state
    if plant.crashed:
        return "crashed"
    height = float(x.p_WB[2]) - simulation.scenario.start.position[2] - simulation.vehicle.standing_height
    held = plant.contact.attached or plant.cables.hold.active
    return ending(Situation(height, float(np.linalg.norm(x.v_WB)), float(tilt_degrees(x.q_WB)), float(plant.rotor_speed.max()), held,
                            state is State.HOVERING))
