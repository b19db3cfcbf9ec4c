"""A plan that continues another in flight: the vehicle arrives as if there had been one plan only."""

import numpy as np
import pytest

from closed_loop.loop import make_loop, perch
from perch_control.admission import AtEnd
from perch_core.trajectory import FlatTrajectory


def rest_of(trajectory, time):
    """The same trajectory from a time [s] on, as a new plan for an unmoved target would be."""
    k, s = trajectory.locate(time)
    work = trajectory.coefficients[k].copy()
    right = [work[:, -1]]
    while work.shape[1] > 1:  # de Casteljau
        work = (1 - s) * work[:, :-1] + s * work[:, 1:]
        right.insert(0, work[:, -1])
    right = np.stack(right, axis=-1)
    durations = np.concatenate([[(1 - s) * trajectory.durations[k]], trajectory.durations[k + 1:]])
    return FlatTrajectory(durations, np.concatenate([right[None], trajectory.coefficients[k + 1:]]))


def arrival(plan, replans):
    """Speed into the surface, speed along it [m/s] and the largest jump of the wanted velocity from step to step [m/s]."""
    loop = make_loop()
    loop.begin_in_hover()
    loop.plant.floor, start = -10.0, loop.time + 0.04
    loop.follow(plan.trajectory, AtEnd.CONTACT, id=2)
    loop.references.clear()
    for number, time in enumerate(replans):
        loop.run(start + time - 0.04 - loop.time)
        loop.follow(rest_of(plan.trajectory, time), AtEnd.CONTACT, id=3 + number)
    loop.run(plan.trajectory.duration + 0.3, until=lambda x: (x.plant.p - plan.contact) @ plan.normal <= 0)
    v, n = loop.plant.v, plan.normal
    velocity = np.diff(np.array(loop.references), axis=0) / 0.002
    return -v @ n, np.linalg.norm(v - (v @ n) * n), np.abs(np.diff(velocity, axis=0)).max()


@pytest.mark.parametrize("name", ["surface_90_1.7m", "surface_90_3m"])
def test_new_plans_in_flight_arrive_like_the_first(name):
    plan = perch(name)
    T = plan.trajectory.duration
    once = arrival(plan, ())
    again = arrival(plan, T - np.arange(1.5, 0.69, -0.1))
    assert again[0] == pytest.approx(once[0], abs=0.1)
    assert again[1] < once[1] + 0.15
    assert again[2] < 0.1  # nothing jumps where a plan takes over
