"""A controller component on a simulated plant whose state is the odometry."""

from __future__ import annotations

import pickle
from functools import cache

import numpy as np

from closed_loop.plant import Disturbances, Plant
from perch_control.controller import Controller
from perch_control.modes import State
from perch_control.parameters import ControllerChoice, ControllerParameters
from perch_core.trajectory import FlatTrajectory, rest_to_rest
from perch_core.values import NANOSECONDS, Command, ControllerCommand, ImuSample, OdometryState, TrajectoryOrder, rotated
from perch_core.vehicle import load_vehicle

_NONE = np.zeros((6, 6))
START = 3 * NANOSECONDS


def parameters(**choice) -> ControllerParameters:
    return ControllerParameters(controller=ControllerChoice(**choice))


class Flight:
    """A controller on a plant whose state is the odometry, at any rate; stamps are whole nanoseconds."""

    def __init__(self, rate: float = 500.0, params: ControllerParameters | None = None,
                 disturbances: Disturbances | None = None) -> None:
        self.component = Controller(params or parameters())
        self.plant = Plant(load_vehicle("snapdragon"), np.zeros(3), disturbances=disturbances or Disturbances(), speed=np.zeros(4))
        self.period, self.stamp = round(1e9 / rate), START
        self.motors, self.status, self.lines, self.references = [], [], [], []
        self.R_BI, self.imu_frame = np.eye(3), "imu_link"
        for name, kept in (("motor_command", self.motors), ("status", self.status), ("log", self.lines), ("reference", self.references)):
            getattr(self.component, name).receivers.append(kept.append)

    def odometry(self, **changes) -> OdometryState:
        s = self.plant.state
        return OdometryState(self.stamp, s[0:3], s[6:10], rotated(s[6:10], s[3:6], -1.0), s[10:13], _NONE, _NONE)._replace(**changes)

    def imu(self, **changes) -> ImuSample:
        w_I, f_I = self.plant.w @ self.R_BI, self.plant.specific_force_B @ self.R_BI
        return ImuSample(self.stamp, tuple(w_I.tolist()), tuple(f_I.tolist()), self.imu_frame)._replace(**changes)

    def step(self, seconds: float, odometry=True, imu=True, **changes) -> None:
        for _ in range(round(seconds * 1e9 / self.period)):
            before = len(self.motors)
            if imu:
                self.component.on_imu(self.imu())
            if odometry:
                self.component.on_odometry(self.odometry(**changes))
            if len(self.motors) > before:
                self.command = self.motors[-1]
            speed = np.array(self.command.rotor_speed) if self.command.armed else np.zeros(4)
            self.plant.advance(speed, self.period * 1e-9, max(2, self.period // 1_000_000))
            self.stamp += self.period

    def follow(self, trajectory, **changes) -> None:
        self.component.on_trajectory(TrajectoryOrder.of(5, trajectory)._replace(**changes))

    def order(self, command: Command, stamp: int = 0) -> None:
        self.component.on_command(ControllerCommand(stamp, int(command), "test"))

    def take_off(self) -> Flight:
        self.step(0.5)
        self.order(Command.ARM)
        self.follow(self.path((0, 0, 0), (0, 0, 0.6), 1.0))
        self.step(1.6)
        assert self.state is State.HOVERING, self.said
        return self

    def path(self, a, b, duration) -> FlatTrajectory:
        return rest_to_rest(np.array(a, float), np.array(b, float), 0.0, 0.0, duration, start_time=self.stamp * 1e-9 + 0.02)

    @property
    def state(self) -> State:
        return self.component.flight.state

    @property
    def said(self) -> str:
        return " | ".join(line.text for line in self.lines)


@cache
def _hover() -> bytes:
    return pickle.dumps(Flight().take_off())


def hovering() -> Flight:
    """A flight with the usual parameters that has taken off: a copy of its own, of one take-off."""
    return pickle.loads(_hover())
