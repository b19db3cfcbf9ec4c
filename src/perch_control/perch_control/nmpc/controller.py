"""Nonlinear model predictive control by real-time iterations: one linearisation and one QP per control period. [P:VI]"""

from __future__ import annotations

from math import dist, isfinite
from typing import TYPE_CHECKING

import numpy as np

from perch_control.flight_state import FlightState
from perch_control.geometric import GeometricController, packed_vehicle
from perch_control.geometric.controller import ACCELERATION_MAX
from perch_control.law import NO_COMPENSATION, ControlOutput, Law
from perch_control.nmpc.condensing import solve_condensed
from perch_control.nmpc.iteration import apply, begin, finish, first_command, input_bounds
from perch_control.nmpc.linearisation import Linearisation
from perch_control.nmpc.model import DISTURBANCE, INPUTS, LINE, LINES, REFERENCE, WEIGHTS, StageLayout
from perch_control.nmpc.qp import QpFailure
from perch_control.nmpc.reference_rows import ReferenceRows
from perch_control.nmpc.riccati import Workspace
from perch_control.nmpc.settings import NmpcSettings
from perch_control.period import NOMINAL_PERIOD
from perch_control.reference import ByState, Following
from perch_control.rotor_lag import RotorEstimate
from perch_core.errors import ConfigError
from perch_core.jit import COMPILED
from perch_core.vehicle import Vehicle

if TYPE_CHECKING:
    from perch_control.parameters import ControllerParameters

_REFERENCE_FLOOR = 0.5   # specific thrust below which the reference's attitude is noise [m/s^2]
_RATE_RESERVE = 1.2      # soft limit of each body rate / what a plan may ask for: feedback has room
_RATE_PRICE, _THRUST_PRICE = 1e5, 1e6  # of half the squared excess over a state's bound [s^2/rad^2, 1/N^2]: far above all weights
_NODES = 20              # shooting intervals N of [P:VI]: 50 ms each over 1 s; what is solved in 2 ms
_TERMINAL = 4.0          # factor of the state weights at the last node, for what comes after the horizon
_THRUST_RATE_WEIGHT = 0.002  # of the rotor thrusts' rates where these are the inputs: keeps the QP strictly convex [s^2/N^2]
_LINE_MARGIN = 0.3       # scaled clearance below which the collision term acts, to act before the line is reached
LINE_RAMP = 3.0          # line terms grow to their weights over so long: at once they would be a jump of the command [s]
_RATE_JUMP = 5.0         # of the body rates, beyond their motion: an iterate that follows it may turn about and not back [rad/s]
_ACTIVE_SETS = 12        # tried in one period before the dense QP is solved
_FAR_LINE = (0.0, 0.0, -1e3, 1.0, 0.0, 0.0, 1.0, 0.01)


class NmpcController(Law):
    """Predictive control law; owns the iterate (states and inputs over the horizon). It falls back to the geometric law where the
    QP fails or the body rates jump, and for references that are guidance by state (a recovery)."""

    name = "nmpc"
    slow = True

    def __init__(self, vehicle: Vehicle, settings: NmpcSettings, fallback: GeometricController, thrust_states: bool = False) -> None:
        """`thrust_states`: 17 states, with the rotor thrusts among them and their rates as inputs, instead of 13."""
        super().__init__(vehicle)
        self._nominal, self.settings, self.fallback = vehicle, settings, fallback
        self.thrust_states = thrust_states
        N, n = _NODES, 17 if thrust_states else 13
        self._spacing = max(1, round(settings.horizon / N / self.period))
        self._dt = self._spacing * self.period
        self._layout = StageLayout(n, settings.lines.any)
        self._stages = Linearisation(vehicle, self._dt, self._layout, N + 1)
        self._constants = packed_vehicle(vehicle)
        self._rows = self._new_rows()
        self._R = np.zeros((N + 1, REFERENCE))
        self.X, self.U = np.zeros((N + 1, n)), np.zeros((N, INPUTS))
        self._start, self._target = np.zeros(n), np.zeros((N, INPUTS))
        self._low, self._high = np.zeros((N, INPUTS)), np.zeros((N, INPUTS))
        self._x_low, self._x_high, self._price = np.full(n, -np.inf), np.full(n, np.inf), np.zeros(n)
        self._dx, self._du, self._work = np.zeros((N + 1, n)), np.zeros((N, INPUTS)), Workspace(N, n)
        self._warm = False
        self._body_rates: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._line_time = 0.0
        self._lines: tuple[tuple[float, ...], ...] = ()
        self._update_weights()
        self._warm_up()

    @classmethod
    def build(cls, vehicle: Vehicle, params: ControllerParameters) -> NmpcController:
        """Build the law; this takes seconds where code must be compiled, and about 0.1 s where the compiled code is cached."""
        return cls(vehicle, params.nmpc, GeometricController.build(vehicle, params))

    @property
    def compiled(self) -> bool:
        """Whether the linearisation runs as machine code."""
        return self._stages.compiled

    def _warm_up(self) -> None:
        """Run one step in hover, so that everything that is compiled on first use is compiled."""
        hover = (self.vehicle.speed_min + self.vehicle.speed_max) / 2
        rest = (0.0,) * 6 + (0.0, 0.0, 0.0, 1.0) + (0.0,) * 3
        self.control(rest, FlightState.disarmed(self.vehicle), RotorEstimate((hover,) * 4, (hover,) * 4))
        self._warm, self.failures = False, 0

    def _update_weights(self) -> None:
        s, n = self.settings, self._layout.states
        self._lead = self.fallback.gains.lead
        self._rate_max, self._thrust_rate_max = _RATE_RESERVE * self._nominal.body_rate_max, _thrust_rate(self.vehicle)
        self.fallback.set_period(self.period)
        z = self._stages.arguments
        k = n + INPUTS + REFERENCE + DISTURBANCE
        z[:, k:k + WEIGHTS] = (*s.position, *s.velocity, *s.attitude, *s.rate, s.thrust)
        self._x_low[10:13], self._x_high[10:13], self._price[10:13] = -self._rate_max, self._rate_max, _RATE_PRICE
        self._x_low[13:], self._x_high[13:], self._price[13:] = self.vehicle.thrust_min, self.vehicle.thrust_max, _THRUST_PRICE

    def retune(self, settings: NmpcSettings, fallback: GeometricController) -> None:
        """Use new weights from the next period on.

        Raises:
            ConfigError: horizon or presence of line terms differ; these are compiled in.
        """
        old = self.settings
        if settings.horizon != old.horizon:
            raise ConfigError("nmpc", "horizon", "is fixed after the start")
        if settings.lines.any != old.lines.any:
            raise ConfigError("nmpc", "lines", "line terms cannot be switched on or off after the start")
        self.settings, self.fallback = settings, fallback
        self._update_weights()

    def retuned(self, params: ControllerParameters) -> NmpcController:
        """As `retune`, from the controller's parameters; nothing is recompiled."""
        self.retune(params.nmpc, GeometricController.build(self._nominal, params))
        return self

    def begin(self) -> None:
        """Take over in flight: the first iterate is the reference, and line terms ramp up."""
        self._warm, self._line_time = False, 0.0

    def set_vehicle(self, vehicle: Vehicle) -> None:
        """Use a vehicle model that differs from the initial one in its thrust; the compiled code takes rotor thrusts only."""
        self.vehicle, self._constants = vehicle, packed_vehicle(vehicle)
        self._rows = self._new_rows()
        self._update_weights()
        self.fallback.set_vehicle(vehicle)

    def set_period(self, period: float) -> None:
        """Use another period of the odometry [s]: the compiled node spacing is kept, as a whole number of new periods."""
        if period == self.period:
            return
        self.period, self._spacing = period, max(1, round(self._dt / period))
        self._rows = self._new_rows()
        self._update_weights()

    def _new_rows(self) -> ReferenceRows:
        period = self.period if self.period == NOMINAL_PERIOD else self._dt / self._spacing
        return ReferenceRows(self._constants, _REFERENCE_FLOOR, _NODES * self._spacing, period)

    def lines(self, lines: tuple[tuple[float, ...], ...]) -> None:
        """Set the powerlines of the soft terms: (centre, direction, half length, radius), 8 floats each; the first is viewed."""
        if not self._lines:
            self._line_time = 0.0
        self._lines = tuple(lines)[:LINES]

    def control(self, state: tuple[float, ...], reference: Following, rotors: RotorEstimate,
                compensation: tuple[float, ...] = NO_COMPENSATION, time_to_contact: float = np.inf) -> ControlOutput:
        """Rotor commands for one period; arguments as in `GeometricController.control`."""
        if isinstance(reference.source, ByState):
            self._warm = False
            return self.fallback.control(state, reference, rotors, compensation, time_to_contact)
        # At a reference's end its thrusts jump.
        left = reference.source.duration - reference.elapsed - self._lead
        ramps = self.settings.ramps and left >= _NODES * self._dt
        ahead = 0.0 if self.thrust_states else self.fallback.lag
        self._rows.fill(reference.source, reference.elapsed + ahead, self._spacing, self._R)
        before, self._body_rates = self._body_rates, state[10:13]
        try:
            if self._warm and dist(before, self._body_rates) > _RATE_JUMP + ACCELERATION_MAX * self.period:
                raise QpFailure("the body rates have jumped")
            speed, wrench, reached = self._iterate(state, rotors, compensation, ahead, ramps)
            if not all(map(isfinite, speed)):
                raise QpFailure("the iterate diverged")
        except QpFailure:
            self.failures += 1
            self._warm = False
            return self.fallback.control(state, reference, rotors, compensation, time_to_contact)
        r, (now, later) = self._R[0].tolist(), self.X[:2, 10:13].tolist()
        dw_C = ((later[0] - now[0]) / self._dt, (later[1] - now[1]) / self._dt, (later[2] - now[2]) / self._dt)
        return ControlOutput(speed, wrench, reached, tuple(r[3:7]), tuple(r[10:13]), dw_C)

    def _iterate(self, state: tuple[float, ...], rotors: RotorEstimate, compensation: tuple[float, ...], ahead: float,
                 ramps: bool) -> tuple:
        """One real-time iteration; returns rotor commands, wrench and the thrusts that will be reached."""
        s, X, U, n = self.settings, self.X, self.U, self._layout.states
        if not self._warm:
            X[:, :13] = self._R[:, :13]
            turned = np.cumprod(np.where((X[1:, 3:7] * X[:-1, 3:7]).sum(axis=1) < 0.0, -1.0, 1.0))
            X[1:, 3:7] *= turned[:, None]  # one sign from node to node: q and -q are the same attitude, and far apart in a linear model
            if self.thrust_states:
                X[:, 13:], U[:] = self._R[:, 13:], 0.0
            else:
                U[:] = self._R[:-1, 13:]
            self._work.clear()
            self._warm = True
        z = self._stages.arguments
        begin(state, rotors.speed, rotors.command, compensation, ahead, self._constants, self._R, ramps, X, U, self._start,
              self._target, z)
        if self._layout.with_lines:
            self._fill_lines(z)
        stages = self._stages.evaluate()
        weight, lead = _THRUST_RATE_WEIGHT if self.thrust_states else s.thrust, self._lead
        input_bounds(rotors.speed, lead, self._constants, self._thrust_rate_max, n, self._low, self._high)
        if COMPILED:
            tried, out = finish(stages, X, U, self._start, weight, self._target, _TERMINAL, self._low, self._high, self._x_low,
                                self._x_high, self._price, _ACTIVE_SETS, self._work.arrays, self._dx, self._du, rotors.speed, lead,
                                self._constants)
            if tried:
                return out
            self._work.clear()
        apply(*solve_condensed(stages, X, U, self._start - X[0], weight, self._target, _TERMINAL, self._low, self._high, self._x_low,
                               self._x_high), X, U)
        return first_command(U, n, rotors.speed, lead, self._constants)

    def _fill_lines(self, z: np.ndarray) -> None:
        weights = self.settings.lines
        self._line_time += self.period if self._lines else 0.0
        ramp = min(self._line_time / LINE_RAMP, 1.0)
        flat = [v for k in range(LINES) for v in (self._lines[k] if k < len(self._lines) else _FAR_LINE)]
        watched = ramp if self._lines else 0.0
        z[:, -(LINES * LINE + 4):] = (*flat, watched * weights.perception, watched * weights.visibility,
                                      ramp * weights.collision, _LINE_MARGIN)


def _thrust_rate(vehicle: Vehicle) -> float:
    """Largest rate of a rotor's thrust [N/s]: the vehicle's own limit, else that of the lag from hover at full command."""
    if np.isfinite(vehicle.thrust_rate_max):
        return float(vehicle.thrust_rate_max)
    hover = np.sqrt(vehicle.hover_thrust / 4.0 / vehicle.thrust_coefficient)
    return float(2.0 * vehicle.thrust_coefficient * hover * (vehicle.speed_max - hover) / vehicle.motor_time_constant)
