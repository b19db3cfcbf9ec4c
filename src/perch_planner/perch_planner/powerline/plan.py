"""A finished powerline plan: states at 1 ms, certificates, and the trajectory for the controller. [P:V-B]"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perch_core.rotor_model import P, Q, THRUST, V, W, RotorModel, accelerations
from perch_core.trajectory import SampledTrajectory
from perch_core.values import Certificate


@dataclass(frozen=True)
class Manoeuvre:
    """A checked perch or recovery.

    Attributes:
        times: [s], shape (m,), from 0, about 1 ms apart.
        states: shape (m, 17), see `rotor_model`.
        rates: thrust rates [N/s], shape (m, 4).
        bounds: certificates of the checked limits.
        intervals: N of the accepted solve.
        solver: fatrop or ipopt.
        iterations: of all solves.
        solve_time: wall-clock time of all solves [s].
        cpu_time: processor time of all solves [s]; equals `solve_time` on an idle machine.
        cost: value of [P:eq14a].
    """

    times: np.ndarray
    states: np.ndarray
    rates: np.ndarray
    bounds: tuple[Certificate, ...]
    intervals: int
    solver: str
    iterations: int
    solve_time: float
    cpu_time: float
    cost: float

    @property
    def duration(self) -> float:
        """T [s]."""
        return float(self.times[-1])


@dataclass(frozen=True)
class PowerlinePlan:
    """A perch, a recovery, or a perch followed by a recovery.

    Attributes:
        perch, recovery: None where not requested; the recovery also where none was found.
        without_recovery: reason why a requested recovery is missing; empty otherwise.
    """

    perch: Manoeuvre | None
    recovery: Manoeuvre | None
    without_recovery: str = ""

    @property
    def parts(self) -> tuple[Manoeuvre, ...]:
        """The manoeuvres of the plan in order."""
        return tuple(part for part in (self.perch, self.recovery) if part is not None)

    @property
    def bounds(self) -> tuple[Certificate, ...]:
        """Every certificate; those of an appended recovery are named `recovery_*`."""
        if self.perch is None or self.recovery is None:
            return tuple(bound for part in self.parts for bound in part.bounds)
        shift = self.perch.duration
        recovery_bounds = (replace(b, quantity=f"recovery_{b.quantity}", time_of_minimum=b.time_of_minimum + shift,
                                   time_of_maximum=b.time_of_maximum + shift) for b in self.recovery.bounds)
        return (*self.perch.bounds, *recovery_bounds)

    def trajectory(self, model: RotorModel, start_time: float = 0.0, step: float = 0.0) -> SampledTrajectory:
        """Perch and recovery as one trajectory for the controller.

        Args:
            model: constants.
            start_time: stamp of the start [s].
            step: desired spacing of the samples [s]; 0: all, about 1 ms. Start, end and the joint are always included.
        """
        times: list[np.ndarray] = []
        states: list[np.ndarray] = []
        begin = 0.0
        for part in self.parts:
            stride = max(1, round(step * (len(part.times) - 1) / part.duration))
            rows = np.append(np.arange(0, len(part.times) - 1, stride), len(part.times) - 1)[1 if times else 0:]
            times.append(begin + part.times[rows])
            states.append(part.states[rows])
            begin += part.duration
        x = np.concatenate(states)
        a_W, dw_B = accelerations(model, x)
        return SampledTrajectory(times=np.concatenate(times), p=x[:, P], q=x[:, Q], v=x[:, V], w=x[:, W], a=a_W, dw=dw_B,
                                 rotor_thrust=x[:, THRUST], start_time=start_time)
