"""Perching flights with a fault at a random time, and the end of each flight.

A flight takes off, hovers, and perches on a wall; one fault occurs between the take-off command and the planned contact.
"""

from __future__ import annotations

import contextlib
import copy
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from perch_control.modes import State
from perch_core.errors import PerchError
from perch_core.values import Command, OdometryState, TriggerRequest, seconds
from perch_eval.control_flights.way_out import Search, search
from perch_eval.ending import simulated_ending
from perch_eval.metrics import tilt_degrees
from perch_eval.scripted_flight import LEAD, TAKE_OFF_SPEED, ScriptedFlight, scenario_of
from perch_sim import seeding
from perch_sim.contact_event import ContactState

SCENARIO = "surface_90"
SILENCE_TIME = 3.0   # `flight.silence_time` in these flights [s], as its 60 s take long to simulate
HOVER_TIME = 0.5     # before the perch [s]
SETTLING_TIME = 4.0  # a hover that lasts so long is an end [s]
TIME_LIMIT = 25.0    # after the fault a flight is judged as it is [s]
END_STATES = ("hovering", "landed", "perched")
"""Ends that count as safe."""


Injector = Callable[[ScriptedFlight, np.random.Generator], str]


@dataclass(frozen=True)
class Fault:
    """A fault in flight.

    Attributes:
        name: name in pages and files.
        description: description of the fault.
        inject: function that applies the fault and returns its details.
        scenario: changes to the scenario.
    """

    name: str
    description: str
    inject: Injector
    scenario: dict = field(default_factory=dict)


def _stop_or_repeat_odometry(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    if rng.random() < 0.5:
        flight.loop.filters["controller", "odometry"] = lambda now, state: None
        return "no further odometry"
    last = flight.mission.latest_odometry
    flight.loop.filters["controller", "odometry"] = lambda now, state: last
    return "the last sample again and again"


def _shift_position(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    offset = rng.normal(size=3)
    offset *= rng.uniform(0.3, 2.0) / np.linalg.norm(offset)
    duration = rng.uniform(0.01, 1.0) if rng.random() < 0.5 else np.inf
    end = flight.time + duration

    def jumped(now: int, state: OdometryState) -> OdometryState:
        return state if seconds(now) > end else state._replace(p_WB=tuple((np.array(state.p_WB) + offset).tolist()))

    flight.loop.filters["controller", "odometry"] = jumped
    return f"position jumps by ({offset[0]:.2f}, {offset[1]:.2f}, {offset[2]:.2f}) m" + (f" for {duration:.2f} s" if np.isfinite(duration) else " for good")


def _stop_vio(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    for channel in ("vio/state", "vio/odometry"):
        flight.loop.filters["estimator", channel] = lambda now, value: None
    return "no further VIO pose"


def _stop_trajectories(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    flight.loop.filters["controller", "trajectory"] = lambda now, order: None
    return "no further trajectory"


def _add_body_rate(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    axis = rng.normal(size=3) * (1.0, 1.0, 0.3)
    w = axis / np.linalg.norm(axis) * rng.uniform(8.0, 20.0)
    x, plant = flight.simulation.state, flight.simulation.plant
    plant.place(x.p_WB, x.q_WB, x.v_WB, x.w_WB_B + w, plant.rotor_speed)
    return f"a blow turns the vehicle with ({w[0]:.1f}, {w[1]:.1f}, {w[2]:.1f}) rad/s"


def _weaken_rotors(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    vehicle, plant = flight.simulation.vehicle, flight.simulation.plant
    hover = vehicle.mass * 9.81 / (4.0 * vehicle.thrust_max)
    share = rng.uniform(0.95, 1.3) * hover
    plant.body = plant.body._replace(thrust_coefficient=plant.body.thrust_coefficient * share)
    return f"all rotors give at most {100 * share / hover:.0f} % of the weight"


def _move_fence(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    parameters = flight.controller.config
    limits, axis = parameters.flight, rng.integers(3)
    low, high = np.array(limits.fence_low), np.array(limits.fence_high)
    p, outside = flight.mission.p_WB, rng.uniform(-0.3, 1.5)
    if axis == 2 or rng.random() < 0.5:
        high[axis] = p[axis] - outside
    else:
        low[axis] = p[axis] + outside
    flight.controller.reconfigure(replace(parameters, flight=replace(limits, fence_low=tuple(low.tolist()), fence_high=tuple(high.tolist()))))
    return f"the fence stands {abs(outside):.2f} m {'behind' if outside > 0 else 'ahead of'} the vehicle along {'xyz'[axis]}"


def _abort(flight: ScriptedFlight, rng: np.random.Generator) -> str:
    _stop_trajectories(flight, rng)
    if rng.random() < 0.5:
        flight.loop.request("controller", "abort", TriggerRequest())
        return "abort"
    flight.mission.order(Command.HOVER, "the goal was cancelled")
    return "cancel: hover"


FAULTS = (
    Fault("stale odometry", "odometry stops, or repeats its last sample", _stop_or_repeat_odometry),
    Fault("jumping odometry", "the position jumps by 0.3 to 2 m, for up to 1 s or for good", _shift_position),
    Fault("lost VIO", "no further VIO pose reaches the estimator", _stop_vio),
    Fault("planner silence", f"no further trajectory is sent; `flight.silence_time` {SILENCE_TIME:g} s instead of 60 s", _stop_trajectories),
    Fault("excess tilt, rate", "a blow adds 8 to 20 rad/s about a random axis", _add_body_rate),
    Fault("low thrust margin", "all rotors weaken: the greatest thrust falls to 95 to 130 % of the weight", _weaken_rotors),
    Fault("geofence", "the fence is moved to between 0.3 m ahead of and 1.5 m behind the vehicle", _move_fence),
    Fault("missed contact", "the velcro does not hold", lambda *_: "the velcro does not hold", {"adhesion": {"enabled": False}}),
    Fault("abort", "`abort`, or the goal is cancelled (HOVER)", _abort),
)


@dataclass(frozen=True)
class Ending:
    """End of a flight with a fault.

    Attributes:
        fault, seed: name of the fault, and seed of the flight.
        time: time of the fault since the take-off command [s].
        phase: state of the controller at the fault.
        done: details of the applied fault.
        before: true height of the centre of mass [m], distance from the wall [m], speed [m/s], tilt [deg] at the fault.
        end: hovering, landed, perched, crashed or lost.
        touched: collisions, each with the body that was hit and the normal speed.
        events: events of the controller from the fault on.
        search: search for a way out from the state at the fault; None if the end is safe.
    """

    fault: str
    seed: int
    time: float
    phase: str
    done: str
    before: tuple[float, float, float, float]
    end: str
    touched: tuple[str, ...]
    events: tuple[str, ...]
    search: Search | None = None


def fly_fault(fault: Fault, seed: int) -> Ending:
    """Fly one flight with one fault.

    Args:
        fault: fault to be applied.
        seed: seed of the flight, and of the fault's time and size.
    """
    scenario = scenario_of(SCENARIO, fault.scenario, {"flight.silence_time": SILENCE_TIME})
    flight = ScriptedFlight(scenario, seed)
    rng = seeding.stream(seed, f"fault {fault.name}")
    flight.arm()
    begin, height = flight.time + 0.2, flight.scenario.mission.takeoff_height
    rise = max(1.0, height / TAKE_OFF_SPEED)
    ready = begin + LEAD + rise + HOVER_TIME
    place = flight.mission.p_WB + (0.0, 0.0, height)
    contact = ready + 2.0 * LEAD + flight.perch_plan(place, begin, np.zeros(3)).duration
    moment = rng.uniform(begin, contact)

    def perch() -> None:
        with contextlib.suppress(PerchError):  # there is no plan from the estimated position: the mission gives up, the vehicle hovers
            flight.perch(place)

    script = [(begin, lambda: flight.mission.move(np.array([0.0, 0.0, height]), rise)), (ready, perch)]
    injected, done, phase, before, first = False, "", "", (0.0,) * 4, 0
    hovering_since = flight.time
    while flight.time < moment + TIME_LIMIT and not flight.simulation.plant.crashed:
        while script and flight.time >= script[0][0]:
            script.pop(0)[1]()
        if not injected and flight.time >= moment:
            injected, phase, before, first = True, flight.state.name, _true_state(flight), len(flight.events)
            done = fault.inject(flight, rng)
            plant = copy.deepcopy(flight.simulation.plant)
        flight.step()
        if flight.state is not State.HOVERING:
            hovering_since = flight.time
        if injected and flight.state in (State.RECOVERING, State.LANDING, State.FAILED):
            script.clear()  # the mission gives up
        off = flight.state in (State.DISARMED, State.FAILED, State.ATTACHED)
        if injected and not script and (flight.time - hovering_since > SETTLING_TIME or off and flight.time > moment + 1.0):
            break
    if flight.state in (State.DISARMED, State.FAILED, State.ATTACHED):
        flight.run(flight.time + 1.0)  # a vehicle that has come off falls within this time
    touched = tuple(sorted({f"{c.body} {c.normal_speed:.1f} m/s" for c in flight.loop.trace.contacts if c.state == ContactState.COLLISION}))
    end = _end(flight)
    return Ending(fault.name, seed, moment - begin, phase, done, before, end, touched,
                  tuple(f"{t - begin:.2f} s {state}: {text}" for t, state, text in flight.events[first:]),
                  None if end in END_STATES or not injected else search(plant))


def _true_state(flight: ScriptedFlight) -> tuple[float, float, float, float]:
    x, pad = flight.simulation.state, flight.simulation.pad
    return (float(x.p_WB[2]), float((x.p_WB - pad.p_WS) @ pad.normal), float(np.linalg.norm(x.v_WB)), float(tilt_degrees(x.q_WB)))


def _end(flight: ScriptedFlight) -> str:
    end = simulated_ending(flight.simulation, flight.state)
    return end if end in (*END_STATES, "crashed") else "lost"
