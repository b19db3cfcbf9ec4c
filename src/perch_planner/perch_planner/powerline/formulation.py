"""How the nonlinear program of [P:eq14] is written down: its costs and discretisation, ours and those of the paper's authors."""

from __future__ import annotations

from dataclasses import dataclass, replace


@dataclass(frozen=True, kw_only=True)
class Weights:
    """Cost weights of a manoeuvre. [P:eq15]

    Attributes:
        thrust: rotor impulse.
        rate, rate_between: body rate at the nodes, and in the middle between them.
        xy_end, z_end: horizontal position and height at the end.
        tilt_end, v_end, w_end: direction of b3, velocity and body rate at the end.
        thrust_end: rotor thrust at the end, against hover, so that hover can follow.
    """

    thrust: float = 0.02
    rate: float = 0.3
    rate_between: float = 0.3
    xy_end: float = 3000.0
    z_end: float = 3000.0
    tilt_end: float = 3000.0
    v_end: float = 100.0
    w_end: float = 10.0
    thrust_end: float = 0.0


@dataclass(frozen=True, kw_only=True)
class Formulation:
    """The program and what makes its solution a plan.

    Attributes:
        perch, recovery: cost weights; of a recovery, upright and at rest matters, where it ends hardly.
        hard_end: the end is a constraint of the program, within a fifth of `accuracy`; else it has its costs alone, as in the paper.
        ramp: input in the impulse of [P:eq15]; 0: as the equation says.
        accuracy: position [m] at the end of a perch, tilt [deg] and speed [m/s] at every end; a plan that is worse is refused.
    """

    perch: Weights = Weights()
    recovery: Weights = Weights(thrust=0.08, xy_end=0.5, z_end=0.1, tilt_end=1000.0, v_end=1000.0, thrust_end=10.0)
    hard_end: bool = True
    ramp: float = 0.0
    accuracy: tuple[float, float, float] = (0.001, 0.1, 0.02)


OURS = Formulation()
PUBLISHED = replace(OURS, perch=Weights(rate_between=0.0), hard_end=False, ramp=0.5, accuracy=(0.005, 1.0, 0.2))
"""The authors' code, to compare with its trajectories."""
