"""Formulation of the nonlinear program of [P:eq14]: weights and end conditions, the default ones and those of the paper's authors."""

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
    """A variant of the program, and the accuracy that its solution needs.

    Attributes:
        perch, recovery: cost weights; those of a recovery weight attitude and rest at the end, and hardly the position.
        hard_end: the end is constrained, within a fifth of `accuracy`; otherwise it only has costs, as in the paper.
        ramp: factor of the input in the impulse of [P:eq15]; 0: that of the equation.
        accuracy: position [m] at the end of a perch, tilt [deg] and speed [m/s] at every end; a less accurate plan is refused.
    """

    perch: Weights = Weights()
    recovery: Weights = Weights(thrust=0.08, xy_end=0.5, z_end=0.1, tilt_end=1000.0, v_end=1000.0, thrust_end=10.0)
    hard_end: bool = True
    ramp: float = 0.0
    accuracy: tuple[float, float, float] = (0.001, 0.1, 0.02)


DEFAULT = Formulation()
PUBLISHED = replace(DEFAULT, perch=Weights(rate_between=0.0), hard_end=False, ramp=0.5, accuracy=(0.005, 1.0, 0.2))
"""Formulation of the authors' code, for comparison with its trajectories."""
