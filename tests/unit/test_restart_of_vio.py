"""VIO that works on images is started again: in a hover and on the floor, the estimator's odometry goes on where it was."""

import numpy as np
from perch_eval.goal import goal_of, outcome_of
from perch_eval.in_process import Sensing, arrange
from perch_eval.in_process.parameters import NodeParameters
from perch_sim.scenario import load_scenario

SCENARIO = load_scenario("surface_90")


def restarted(seed, at, goal=True):
    """A flight whose VIO has just been replaced at a time [s], and its goal."""
    loop = arrange(SCENARIO, seed, Sensing(vio="rendered"))
    sent = loop.send("mission", goal_of(SCENARIO)) if goal else None
    while loop.time < at:
        loop.step()
    loop.restart("vio", NodeParameters(SCENARIO, seed).component("vio"))
    return loop, sent


def largest_error(loop, since):
    """Largest error of the odometry's position since a time [m]."""
    truth = {value.stamp: value.p_WB for value in loop.trace.values("ground_truth/odometry")}
    return max(np.linalg.norm(np.subtract(value.p_WB, truth[value.stamp]))
               for value in loop.trace.values("odometry") if value.stamp in truth and value.stamp > since * 1e9)


def test_in_a_hover_the_odometry_goes_on():
    loop, goal = restarted(4, 3.2)
    while goal.result is None:
        loop.step()
    end = loop.time
    while loop.time < end + 1.0:
        loop.step()
    assert outcome_of(goal.result.error_code, SCENARIO) == "perched"
    assert loop.components["vio"].result.outcome.has_pose
    assert largest_error(loop, 3.2) < 0.1
    assert loop.trace.values("estimator/status")[-1].vio_age < 0.3
    loop.close()


def test_on_the_floor_it_rests_where_it_was():
    loop, _ = restarted(1, 1.6, goal=False)
    before = loop.trace.values("odometry")[-1].stamp
    while loop.time < 3.2:
        loop.step()
    assert loop.components["vio"].result.outcome.name == "RESTING"
    assert largest_error(loop, before * 1e-9) < 0.02
    loop.close()
