"""A surface that is nearer or farther than believed: the contact comes early or late, and holds all the same."""

from __future__ import annotations

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from perch_control.admission import AtEnd
from perch_control.geometric import GeometricController
from perch_control.modes import State
from perch_control.parameters import ControllerParameters
from perch_core.vehicle import load_vehicle
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.scenario import Adhesion, load_scenario


def touch(name, farther):
    """Speeds into and along the surface [m/s], and the controller's state, at the contact.

    Args:
        name: of a stored plan.
        farther: distance of the surface behind the place at which it is believed to be [m].
    """
    plan, vehicle = perch(name), load_vehicle("snapdragon")
    params = NodeParameters(load_scenario("surface_90"), 1).node_config("controller", ControllerParameters)  # those that are flown
    loop = make_loop(settings=params.flight, law=GeometricController(vehicle, params.gain_set))
    loop.begin_in_hover()
    loop.plant.floor = -10.0
    law, end, left = loop.controller.law, loop.time + 0.04 + plan.trajectory.duration, []
    control = law.control
    law.control = lambda *arguments: left.append(arguments[4]) or control(*arguments)
    loop.follow(plan.trajectory, AtEnd.CONTACT)
    assert loop.run(plan.trajectory.duration + 0.3, until=lambda x: (x.plant.p - plan.contact) @ plan.normal <= -farther)
    assert left[-1] == pytest.approx(max(end - loop.time, 0.0), abs=0.003), "the law knows when the contact is planned"
    v, n = loop.plant.v, plan.normal
    return -v @ n, np.linalg.norm(v - (v @ n) * n), loop.controller.state


@pytest.mark.parametrize("name, farther", [
    ("surface_90_1.7m", -0.037), ("surface_90_1.7m", 0.037), ("surface_90_3m", -0.037), ("surface_90_3m", 0.037),
    ("surface_60_1.7m", -0.037), ("surface_60_1.7m", 0.045), ("surface_60_3m", -0.037), ("surface_60_3m", 0.045)])
def test_the_velcro_holds_where_the_surface_is_centimetres_off(name, farther):
    adhesion = Adhesion()
    into, along, state = touch(name, farther)
    assert adhesion.normal_speed[0] < into < adhesion.normal_speed[1]
    assert along < adhesion.tangential_speed_max
    assert state is State.TRACKING, "nobody has given it up by then"
