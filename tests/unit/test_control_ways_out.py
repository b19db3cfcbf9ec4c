"""Ways out without odometry: time goes on, speed is braked, walls are not the ground; and the flights of the fault tables."""

from __future__ import annotations

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from closed_loop.plant import Disturbances
from perch_control.admission import AtEnd, TrajectoryRefused
from perch_control.descent import BlindDescent
from perch_control.flight_settings import FlightSettings
from perch_control.modes import State
from perch_core.trajectory import rest_to_rest
from perch_core.vehicle import ControlGains, load_vehicle
from perch_eval.control_flights.faults import END_STATES, FAULTS, fly_fault
from perch_eval.control_flights.way_out import search
from perch_eval.scripted_flight import ScriptedFlight
from perch_sim.scenario import load_scenario


def repeat_last(loop):
    """From now on the same sample with the same stamp, while the IMU goes on."""
    last = loop.flight.trace.values("odometry")[-1]
    loop.flight.filters["controller", "odometry"] = lambda now, state: last


def fast_loop():
    loop = make_loop()
    loop.begin_in_hover()
    p = loop.plant.p.copy()
    loop.follow(rest_to_rest(p, p + [4, 0, 0], 0, 0, 3.0), id=3)
    loop.run(1.5)
    assert loop.plant.v[0] > 2.0
    return loop


def test_odometry_that_repeats_itself_ends_in_a_descent_that_brakes():
    loop = fast_loop()
    begin, speed = loop.plant.p.copy(), loop.plant.v[0]
    repeat_last(loop)
    loop.run(1.2)
    assert loop.controller.state is State.LANDING and loop.controller.flight_state.blind
    assert abs(loop.plant.v[0]) < 0.3, "the speed of the last sample is braked"
    assert loop.plant.p[0] - begin[0] < 0.6 * 1.2 * speed, "much less than it would have coasted"
    assert loop.run(5.0, until=lambda x: x.controller.state is State.DISARMED), loop.events
    assert loop.plant.p[2] < 0.02 and loop.plant.impact_speed < 1.2


def descent(v):
    vehicle = load_vehicle("snapdragon")
    return BlindDescent(vehicle, ControlGains(), (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0), 0.0, 0.0, v)


@pytest.mark.parametrize("blow, ends", [((60.0, 0.0, 9.0), False), ((0.0, 0.0, 60.0), True)])
def test_the_ground_pushes_upwards_and_a_wall_does_not(blow, ends):
    x = descent((0.0, 0.0, 0.0))
    for k in range(1000):
        force = blow if k in (400, 401) else (0.0, 0.0, 9.81) if ends and k > 401 else (0.0, 0.0, 9.12)
        x.imu(0.002 * k, (0.0, 0.0, 0.0), force)
    assert x.landed is ends


def test_a_velocity_that_cannot_be_is_not_braked():
    thrust, *moment = descent((30.0, 0.0, 0.0)).wrench()
    np.testing.assert_allclose(moment, 0.0, atol=1e-12)
    assert descent((2.0, 0.0, 0.0)).wrench()[2] < 0.0, "moving along +x, the vehicle leans back"


def test_a_descent_brakes_a_climb_and_a_fast_fall_and_lets_a_slow_one_go_on():
    thrust = {climb: descent((0.0, 0.0, climb)).wrench()[0] for climb in (2.0, 0.5, 0.0, -0.5, -1.0, -3.0)}
    weight = load_vehicle("snapdragon").mass * 9.81
    assert thrust[2.0] < thrust[0.5] < thrust[0.0] == thrust[-0.5] < weight < thrust[-1.0] < thrust[-3.0]


def test_neither_lost_vio_nor_the_geofence_brakes_into_the_wall():
    plan = perch("surface_90_1.7m")

    def flown(before):
        loop = make_loop(floor=-10.0)
        loop.begin_in_hover()
        loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
        loop.run(0.04 + plan.trajectory.duration - before)
        flight, (x, _, _) = loop.controller, loop.plant.p
        flight.use(flight.law, flight.gains, FlightSettings(fence_high=(x - 0.1, 20.0, 20.0)))
        at_fence = flight.supervisor.act(flight.flight_state, False).mode
        flight.use(flight.law, flight.gains, FlightSettings())
        flight.estimator(2, 1.5, "")
        return at_fence, flight.state

    assert flown(0.4) == (State.TRACKING,) * 2, "no brake ends before the wall"
    assert flown(1.4) == (State.HOVERING,) * 2, "there is room to brake"


@pytest.mark.parametrize("share, flies", [(0.6, False), (1.0, True)])
def test_weak_rotors_do_not_begin_a_perch(share, flies):
    plan = perch("surface_90_1.7m")
    loop = make_loop(disturbances=Disturbances(rotor_factor=(share,) * 4))
    loop.begin_in_hover()
    loop.run(1.5)
    try:
        loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    except TrajectoryRefused as refusal:
        assert not flies and "the vehicle is landing" in str(refusal)
    else:
        assert flies


@pytest.mark.parametrize("name", ["abort", "jumping odometry"])
def test_a_fault_flight_has_a_good_end(name):
    """That the same seed is the same flight is shown in `test_control_weak_rotors.py`, where one is short."""
    ending = fly_fault(next(f for f in FAULTS if f.name == name), 4)
    assert ending.done and ending.end in END_STATES, ending


def test_the_end_is_judged_by_the_truth():
    """A controller that believes to hover is not hovering on the floor."""
    from perch_eval.control_flights import faults

    flight = ScriptedFlight(load_scenario("surface_90"), 1)
    assert faults._end(flight) == "landed"
    x = flight.simulation.state
    flight.simulation.plant.place(x.p_WB + (0.0, 0.0, 1.0), x.q_WB, x.v_WB, x.w_WB_B, np.zeros(4))
    assert faults._end(flight) == "lost"


@pytest.mark.parametrize("w, saved", [((9.6, 14.8, 5.8), False), ((1.0, -1.0, 0.5), True)])
def test_the_search_for_a_way_out_knows_hopeless_from_harmless(w, saved):
    """A blow on the floor: 18 rad/s tip a vehicle onto its rotors before they turn up, 1.4 rad/s do not."""
    flight = ScriptedFlight(load_scenario("surface_90"), 1)
    plant, x = flight.simulation.plant, flight.simulation.state
    plant.place(x.p_WB, x.q_WB, x.v_WB, np.array(w), np.full(4, plant.body.speed_min))
    found = search(plant)
    assert (found.survived > 0) is saved and (saved or found.turn_deg < 10.0)
    assert np.allclose(flight.simulation.state.w_WB_B, w), "it looks at a copy"


def test_a_vehicle_lost_in_the_climb_for_whose_place_there_is_no_plan_ends_safely():
    assert fly_fault(next(fault for fault in FAULTS if fault.name == "lost VIO"), 12).end in END_STATES
