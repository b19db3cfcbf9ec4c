"""Nonlinear model predictive control by real-time iterations: one linearisation and one QP per control period. [P:VI]"""

from __future__ import annotations

from typing import Any

import numpy as np

from perch_control.geometric import ControlOutput, GeometricController, packed_vehicle
from perch_control.geometric.controller import NO_COMPENSATION
from perch_control.geometric.step import drag_compensation, predicted, rotors_for, wrench_of
from perch_control.nmpc.condensing import condense, expand, unpack
from perch_control.nmpc.linearisation import Linearisation
from perch_control.nmpc.model import DISTURBANCE, INPUTS, LINE, LINES, REFERENCE, WEIGHTS, StageLayout
from perch_control.nmpc.qp import QpFailure, solve
from perch_control.nmpc.reference_rows import ReferenceRows
from perch_control.nmpc.settings import NmpcSettings
from perch_control.reference import Following, Resting
from perch_control.rotor_lag import RotorEstimate, approached, reachable, thrusts
from perch_core.errors import ConfigError
from perch_core.timing import CONTROL_PERIOD
from perch_core.vehicle import Vehicle

_REFERENCE_FLOOR = 0.5   # specific thrust below which the reference's attitude is noise [m/s^2]
_NEAR_LIMIT = 0.75       # rate limits enter the QP where the last iterate is beyond this share of them
_RATE_RESERVE = 1.2
_FAR_LINE = (0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 1.0, 0.01)


class NmpcController:
    """Owns the iterate (states and inputs over the horizon); falls back to the geometric law where the QP fails and for
    references that are guidance by state (a recovery)."""

    name = "nmpc"

    def __init__(self, vehicle: Vehicle, settings: NmpcSettings, fallback: GeometricController) -> None:
        self.vehicle, self.settings, self.fallback = vehicle, settings, fallback
        N, n = settings.nodes, 17 if settings.thrust_states else 13
        self._spacing = max(1, round(settings.horizon / N / CONTROL_PERIOD))
        self._dt = self._spacing * CONTROL_PERIOD
        self._layout = StageLayout(n, settings.lines.any)
        self._stages = Linearisation(vehicle, self._dt, self._layout, N + 1)
        self._constants = packed_vehicle(vehicle)
        self._rows = ReferenceRows(self._constants, _REFERENCE_FLOOR)
        self._R = np.zeros((N + 1, REFERENCE))
        self.X, self.U = np.zeros((N + 1, n)), np.zeros((N, INPUTS))
        self._A, self._B, self._c = np.zeros((N, n, n)), np.zeros((N, n, INPUTS)), np.zeros((N, n))
        self._Q, self._q = np.zeros((N + 1, n, n)), np.zeros((N + 1, n))
        self._H, self._h = np.zeros((INPUTS * N,) * 2), np.zeros(INPUTS * N)
        self._xi, self._G = np.zeros((N + 1, n)), np.zeros((N + 1, n, INPUTS * N))
        self._sums = self._dt * np.kron(np.tril(np.ones((N, N))), np.eye(INPUTS))  # inputs -> thrust states
        self._no_rows = np.zeros((0, INPUTS * N)), np.zeros(0), np.zeros(0), np.zeros(0, bool)
        self._warm = False
        self._line_time = 0.0
        self._lines: tuple[tuple[float, ...], ...] = ()
        self.failures = 0
        self._weights()
        self._warm_up()

    @property
    def compiled(self) -> bool:
        """The linearisation runs as machine code."""
        return self._stages.compiled

    def _warm_up(self) -> None:
        """One step in hover: whatever is compiled on first use is compiled now."""
        hover = (self.vehicle.speed_min + self.vehicle.speed_max) / 2
        rest = (0.0,) * 6 + (0.0, 0.0, 0.0, 1.0) + (0.0,) * 3
        self.control(rest, Resting(), RotorEstimate((hover,) * 4, (hover,) * 4))
        self._warm, self.failures = False, 0

    def _weights(self) -> None:
        s, n = self.settings, self._layout.states
        self._rate_max = s.rate_max or _RATE_RESERVE * self.vehicle.body_rate_max
        self._thrust_rate_max = s.thrust_rate_max or _thrust_rate(self.vehicle)
        z = self._stages.arguments
        k = n + INPUTS + REFERENCE + DISTURBANCE
        z[:, k:k + WEIGHTS] = (*s.position, *s.velocity, *s.attitude, *s.rate, s.thrust)

    def retune(self, settings: NmpcSettings, fallback: GeometricController) -> None:
        """New weights and limits from the next period on.

        Raises:
            ConfigError: nodes, horizon, thrust states or the presence of line terms differ: these are compiled in.
        """
        old = self.settings
        for key in ("nodes", "horizon", "thrust_states"):
            if getattr(settings, key) != getattr(old, key):
                raise ConfigError("nmpc", key, "is fixed after the start")
        if settings.lines.any != old.lines.any:
            raise ConfigError("nmpc", "lines", "line terms cannot be switched on or off after the start")
        self.settings, self.fallback = settings, fallback
        self._weights()

    def begin(self) -> None:
        """Take over in flight: the first iterate is the reference."""
        self._warm = False

    def believe(self, vehicle: Vehicle) -> None:
        """Fly a vehicle that differs from the one at the start in its thrust: what is compiled in knows thrusts alone."""
        self.vehicle, self._constants = vehicle, packed_vehicle(vehicle)
        self._rows = ReferenceRows(self._constants, _REFERENCE_FLOOR)
        self.fallback.believe(vehicle)

    def prepare(self, source: Any, contact: bool) -> Any:
        """The reference to follow for a trajectory: itself; the horizon sees the rotors' limits before they act."""
        return source

    def lines(self, lines: tuple[tuple[float, ...], ...]) -> None:
        """Powerlines for the soft terms: (centre, direction, half length, radius), 8 floats each; the first is watched."""
        if not self._lines:
            self._line_time = 0.0
        self._lines = tuple(lines)[:LINES]

    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """Rotor commands for one period; arguments as in `GeometricController.control`."""
        if getattr(reference.source, "by_state", False):
            self._warm = False
            return self.fallback.control(state, reference, rotors, compensation, time_to_contact)
        start = self._start(state, rotors, compensation)
        ahead = 0.0 if self.settings.thrust_states else self.settings.lead
        self._rows.fill(reference.source, reference.elapsed + ahead, self._spacing, self._R)
        try:
            u = self._iterate(start, rotors, compensation)
        except QpFailure:
            self.failures += 1
            self._warm = False
            return self.fallback.control(state, reference, rotors, compensation, time_to_contact)
        return self._answer(u, rotors)

    def _start(self, state: tuple[float, ...], rotors: RotorEstimate, compensation: tuple[float, ...]) -> np.ndarray:
        """Initial state of the horizon: predicted to where the rotors have answered; with thrust states, the present one."""
        mass, J, coefficient = self._constants[0][0], self._constants[0][1:4], self._constants[1][0]
        if not self.settings.thrust_states:
            half = 1.0 - np.exp(-0.5 * self.settings.lead / max(self._constants[1][3], 1e-9))
            f = thrusts(approached(rotors.speed, rotors.command, half), coefficient)
            felt = drag_compensation(state[6:10], state[3:6], self._constants[4], compensation)
            state = predicted(state, f, felt, self.settings.lead, mass, J, self._constants[2])
        x = np.empty(self._layout.states)
        x[0:3], x[3:7], x[7:10], x[10:13] = state[0:3], state[6:10], state[3:6], state[10:13]
        if self.settings.thrust_states:
            x[13:] = np.clip(thrusts(rotors.speed, coefficient), self.vehicle.thrust_min, self.vehicle.thrust_max)
        return x

    def _iterate(self, start: np.ndarray, rotors: RotorEstimate, compensation: tuple[float, ...]) -> np.ndarray:
        """One real-time iteration; returns the first input."""
        s, n, N = self.settings, self._layout.states, self.settings.nodes
        X, U = self.X, self.U
        if not self._warm:
            X[:, :13] = self._R[:, :13]
            if s.thrust_states:
                X[:, 13:], U[:] = self._R[:, 13:], 0.0
            else:
                U[:] = self._R[:N, 13:]
            self._warm = True
        if np.dot(X[0, 3:7], start[3:7]) < 0.0:
            X[:, 3:7] *= -1.0  # the other sign of the same rotations
        z = self._stages.arguments
        z[:, :n], z[:N, n:n + INPUTS] = X, U
        z[:, n + INPUTS:n + INPUTS + REFERENCE] = self._R
        z[:, n + INPUTS + REFERENCE:n + INPUTS + REFERENCE + DISTURBANCE] = np.negative(compensation)
        if self._layout.with_lines:
            self._fill_lines(z)
        unpack(self._stages.evaluate(), X, self._A, self._B, self._c, self._Q, self._q)
        self._Q[N] *= s.terminal
        self._q[N] *= s.terminal
        weight = s.thrust_rate if s.thrust_states else s.thrust
        gradient = weight * (U if s.thrust_states else U - self._R[:N, 13:])
        dx0 = start - X[0]
        condense(self._A, self._B, self._c, self._Q, self._q, gradient, weight, dx0, self._H, self._h, self._xi, self._G)
        du = solve(self._H, self._h, *self._box(rotors), *self._limits())
        expand(self._A, self._B, self._c, dx0, du, X, U)
        X[:, 3:7] /= np.sqrt(np.einsum("ki,ki->k", X[:, 3:7], X[:, 3:7]))[:, None]
        return U[0]

    def _box(self, rotors: RotorEstimate) -> tuple[np.ndarray, np.ndarray]:
        """Bounds of the inputs' changes."""
        U = self.U.ravel()
        if self.settings.thrust_states:
            return -self._thrust_rate_max - U, self._thrust_rate_max - U
        low, high = np.full(len(U), self.vehicle.thrust_min), np.full(len(U), self.vehicle.thrust_max)
        coefficient, speed_min, speed_max, tau = self._constants[1]
        share = 1.0 - np.exp(-self.settings.lead / max(tau, 1e-9))
        slow, fast = reachable(rotors.speed, share, speed_min, speed_max)
        low[:INPUTS], high[:INPUTS] = thrusts(slow, coefficient), thrusts(fast, coefficient)
        return low - U, high - U

    def _limits(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Rows: thrusts at the nodes (17 states), body rates where they are near their limit."""
        N, n = self.settings.nodes, self._layout.states
        free = self.X + self._xi
        near = np.argwhere(np.abs(free[1:, 10:13]) > _NEAR_LIMIT * self._rate_max)
        if n == 13 and not len(near):
            return self._no_rows
        rows = [np.zeros((0, INPUTS * N))]
        low, high = [np.zeros(0)], [np.zeros(0)]
        if n == 17:
            thrust = free[1:, 13:].ravel()
            rows.append(self._sums)
            low.append(self.vehicle.thrust_min - thrust)
            high.append(self.vehicle.thrust_max - thrust)
        if len(near):
            k, axis = near[:, 0] + 1, near[:, 1]
            rows.append(self._G[k, 10 + axis])
            now = free[k, 10 + axis]
            low.append(-self._rate_max - now)
            high.append(self._rate_max - now)
        soft = np.ones(sum(map(len, low)), bool)
        return np.concatenate(rows), np.concatenate(low), np.concatenate(high), soft

    def _fill_lines(self, z: np.ndarray) -> None:
        weights = self.settings.lines
        self._line_time += CONTROL_PERIOD if self._lines else 0.0
        ramp = min(self._line_time / weights.ramp_time, 1.0) if weights.ramp_time > 0.0 else float(bool(self._lines))
        flat = [v for k in range(LINES) for v in (self._lines[k] if k < len(self._lines) else _FAR_LINE)]
        watched = ramp if self._lines else 0.0
        z[:, -(LINES * LINE + 4):] = (*flat, watched * weights.perception, watched * weights.visibility,
                                      ramp * weights.collision, weights.margin)

    def _answer(self, u: np.ndarray, rotors: RotorEstimate) -> ControlOutput:
        s, top = self.settings, self.vehicle.thrust_max
        f = u.tolist()
        if s.thrust_states:
            now = thrusts(rotors.speed, self._constants[1][0])
            f = [min(max(a + s.lead * b, self.vehicle.thrust_min), top) for a, b in zip(now, f)]
        wrench = wrench_of(tuple(f), self._constants[2])
        speed, reached = rotors_for(wrench, rotors.speed, self._constants, s.lead)
        r = self._R[0].tolist()
        return ControlOutput(speed, wrench, reached, tuple(r[3:7]), tuple(r[10:13]),
                             tuple(((self.X[1, 10:13] - self.X[0, 10:13]) / self._dt).tolist()))


def _thrust_rate(vehicle: Vehicle) -> float:
    """Rate that a rotor's lag allows from hover at full command, or the vehicle's own limit [N/s]."""
    if np.isfinite(vehicle.thrust_rate_max):
        return float(vehicle.thrust_rate_max)
    hover = np.sqrt(vehicle.hover_thrust / 4.0 / vehicle.thrust_coefficient)
    return float(2.0 * vehicle.thrust_coefficient * hover * (vehicle.speed_max - hover) / vehicle.motor_time_constant)
