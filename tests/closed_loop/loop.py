"""The controller's component in closed loop with a plant of the tests: what the unit tests and the benchmark fly."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from closed_loop.plant import Disturbances, EstimationError, Plant, PlantVehicle, believed
from perch_control.admission import AtEnd, Order
from perch_control.controller import Controller
from perch_control.flight import FlightController
from perch_control.flight_settings import FlightSettings
from perch_control.geometric import GeometricController
from perch_control.guidance import Hold
from perch_control.maneuvers import entered, following
from perch_control.modes import State
from perch_control.nmpc import NmpcController, NmpcSettings
from perch_control.parameters import ControllerChoice, ControllerParameters
from perch_control.reference import FlatReference
from perch_control.rotor_lag import RotorEstimate
from perch_core.surface import PerchSurface
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import Command, OdometryState, seconds
from perch_core.vehicle import ControlGains, Vehicle, load_vehicle
from perch_eval.in_process import Loop as FlightLoop
from perch_planner.planner import plan
from perch_planner.problem import PerchProblem, PerchSettings, StartState
from closed_loop.truth import TruthEstimator
from perch_sim.lockstep import Task

PERIOD = 0.002
EVERY_STEP = ControllerChoice(reference_period=PERIOD, adaptive=False)  # the law alone; a test of L1 adds it


@dataclass(frozen=True)
class Perch:
    """A plan as shipped for the snapdragon, from a hover at (0, 0, 1.2) m; `contact`: of the centre of mass, where the plate touches."""

    trajectory: FlatTrajectory
    normal: np.ndarray
    contact: np.ndarray


@cache
def perch(name: str, settings: PerchSettings = PerchSettings()) -> Perch:
    """surface_<inclination [deg]>_<distance [m]>m: a surface at the height of the hover."""
    inclination, distance = map(float, name.removeprefix("surface_").removesuffix("m").split("_"))
    surface, vehicle = PerchSurface.from_inclination(np.array([distance, 0.0, 1.2]), np.radians(inclination)), load_vehicle("snapdragon")
    planned = plan(PerchProblem(StartState((0.0, 0.0, 1.2)), surface), settings, vehicle)
    return Perch(planned.trajectory, surface.normal, surface.p_WS + vehicle.perch_offset * surface.normal)


class Believed(TruthEstimator):
    """Gives the controller what `Loop.odometry` makes of the plant."""

    loop: Loop

    def believed(self, state: OdometryState) -> OdometryState:
        """In the place of a true state."""
        return believed(state.stamp, self.loop.odometry(self.loop.plant))


class Loop:
    """A flight: plant, odometry, controller; records what happens.

    Attributes:
        controller: the flight controller in its component.
        flight: the loop that moves the components.
        odometry: what the controller is told, from the plant; by default the truth.
        events: (time, state, text).
        states, references: true state and reference position at each step in flight.
    """

    def __init__(self, component: Controller, plant: Plant) -> None:
        self.controller: FlightController = component.flight
        self.plant = plant
        self.odometry: Callable[[Plant], tuple[float, ...]] = lambda plant: plant.state
        self.events: list[tuple[float, str, str]] = []
        self.states: list[np.ndarray] = []
        self.references: list[np.ndarray] = []
        estimator = Believed()
        estimator.loop = self
        self.flight = FlightLoop(PlantVehicle(plant), {"estimator": estimator, "controller": component},
                                 {"estimator": Task(), "controller": Task()}, {})
        component.log.receivers.append(lambda line: self.events.append((self.flight.time, self.controller.state.name, line.text)))
        component.reference.receivers.append(self._follows)

    def _follows(self, reference: Any) -> None:
        self.states.append(np.array(self.plant.state))
        self.references.append(np.array(reference.p))

    @property
    def time(self) -> float:
        """Of the next step [s]."""
        return seconds(self.flight.vehicle.next)

    def run(self, duration: float, until: Callable[[Loop], bool] | None = None) -> bool:
        """Fly on; True when `until` became true before the time was over."""
        for _ in range(round(duration / PERIOD)):
            self.flight.step()
            if until is not None and until(self):
                return True
        return False

    def follow(self, trajectory: FlatTrajectory, at_end: AtEnd = AtEnd.HOLD, contact_time: float = 0.25, id: int = 1,
               delay: float = 0.04) -> None:
        """Give the controller a trajectory that starts `delay` seconds from now."""
        self.controller.follow(Order(id, FlatReference(trajectory), self.time + delay, at_end, contact_time))

    def begin_in_hover(self, p=(0.0, 0.0, 1.2)) -> None:
        """Put the vehicle into a hover at `p` without flying there."""
        plant, flight = self.plant, self.controller
        plant.p, hover = np.array(p, float), plant.vehicle.mass * 9.81 / 4 / plant.vehicle.thrust_coefficient
        plant.speed = np.full(4, np.sqrt(hover))
        self.run(PERIOD)
        self.flight.vehicle.command = None
        rotors = RotorEstimate(tuple(plant.speed.tolist()), tuple(plant.speed.tolist()))
        hovering = entered(flight.flight_state, State.HOVERING, "in the air")._replace(rotors=rotors)
        flight.flight_state = following(hovering, Hold.at(plant.p, (0.0, 1.0, 0.0)))
        self.run(0.3)

    def take_off(self, height: float = 1.2) -> None:
        """From the ground to a hover."""
        self.run(0.1)
        self.controller.command(Command.ARM)
        p = self.plant.p.copy()
        self.follow(rest_to_rest(p, p + [0, 0, height], 0.0, 0.0, max(1.0, height / 0.8)))
        self.run(max(1.0, height / 0.8) + 0.5)

    def move_rmse(self) -> float:
        """A move of 2 m, 1 m, 0.5 m in 2 s from a hover, begun when an adaptation has settled: RMSE over all axes [m]."""
        self.begin_in_hover()
        self.run(1.0)
        hover = self.references[-1]
        self.states.clear(), self.references.clear()
        self.follow(rest_to_rest(hover, hover + [2, 1, 0.5], 0, 0.5, 2.0))
        self.run(2.4)
        return float(np.linalg.norm(self.rmse))

    @property
    def rmse(self) -> np.ndarray:
        """RMS of the distance to the reference per axis over the recorded steps [m], shape (3,)."""
        return np.sqrt(np.mean((np.array(self.states)[:, :3] - np.array(self.references)) ** 2, axis=0))


def predictive(vehicle: Vehicle | None = None, thrust_states: bool = False, **settings: Any) -> NmpcController:
    """The predictive controller with some settings of its own; the Snapdragon vehicle by default."""
    vehicle = vehicle or load_vehicle("snapdragon")
    return NmpcController(vehicle, NmpcSettings(**settings), GeometricController(vehicle, ControlGains()), thrust_states)


def make_loop(vehicle: Vehicle | None = None, p=(0.0, 0.0, 0.0), disturbances: Disturbances | None = None,
              noise_seed: int | None = None, settings: FlightSettings | None = None, law=None, **plant) -> Loop:
    """A vehicle at rest on the ground with its controller."""
    vehicle = vehicle or load_vehicle("snapdragon")
    gains = ControlGains()
    component = Controller(ControllerParameters(vehicle=vehicle.name, controller=EVERY_STEP, flight=settings or FlightSettings()))
    if law is not None:
        component.flight.use(law, gains, settings or FlightSettings())
    body = Plant(vehicle, p, speed=np.zeros(4), disturbances=disturbances or Disturbances(), **plant)
    loop = Loop(component, body)
    if noise_seed is not None:
        loop.odometry = EstimationError(noise_seed)
    return loop


@dataclass(frozen=True)
class Arrival:
    """How a vehicle meets the surface: speeds [m/s], tilt [deg], distance from the wanted point [m], time late [s]."""

    normal_speed: float
    tangential_speed: float
    tilt_deg: float
    offset: float
    late: float
    rmse: np.ndarray

    @property
    def holds(self) -> bool:
        """Within the velcro's limits (scenario `Adhesion`)."""
        return 0.2 <= self.normal_speed <= 1.0 and self.tangential_speed <= 0.6 and self.tilt_deg <= 15.0


def fly_to_contact(plan: Perch, **options) -> tuple[Arrival, Loop]:
    """From a hover, fly a perch, and measure the arrival at the plane of the pad."""
    loop = make_loop(**options)
    loop.begin_in_hover()
    loop.states.clear(), loop.references.clear()
    loop.plant.floor = -10.0  # the plan's lowest point is 15 cm above the ground: the test is about the wall
    start = loop.time + 0.04
    loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    loop.run(plan.trajectory.duration + 0.4, until=lambda x: (x.plant.p - plan.contact) @ plan.normal <= 0)
    plant, n = loop.plant, plan.normal
    along = plant.v - (plant.v @ n) * n
    gap = plant.p - plan.contact
    tilt = np.degrees(np.arccos(np.clip(plant.R[:, 2] @ n, -1, 1)))
    return Arrival(float(-plant.v @ n), float(np.linalg.norm(along)), float(tilt),
                   float(np.linalg.norm(gap - (gap @ n) * n)), loop.time - start - plan.trajectory.duration, loop.rmse), loop
