"""The mission as a component: a perch through its ports, planners that fail, hang or are missing, bad goals and bad input."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from perch_control.mission.parameters import MissionParameters
from perch_control.mission.settings import MissionSettings
from perch_control.mission.values import Command, ControllerState, Result
from perch_control.mission_component import Mission
from perch_core import so3
from perch_core.component import Unavailable
from perch_core.surface import PerchSurface
from perch_core.trajectory import SampledTrajectory, rest_to_rest
from perch_core.values import (
    NANOSECONDS, ControllerStatus, EstimatorHealth, ImuSample, MappedPowerline, OdometryState, PerchGoal, PerchPlan, PowerlineMap, PowerlinePlan,
    TargetPose, Transform, TriggerRequest, seconds)
from perch_core.vehicle import GRAVITY

TICK, NAN = 20_000_000, float("nan")
SURFACE = PerchSurface.from_inclination(np.array([1.7, 0.0, 1.2]), math.pi / 2)
Q_PERCH = so3.quat_from_matrix(SURFACE.R_WS)
LEVEL = (0.0, 0.0, 0.0, 1.0)
NONE = np.zeros((6, 6))


class Sent:
    """A goal, as a host hands it over."""

    def __init__(self, value):
        self.value, self.cancel_requested, self.told, self.ending, self.result = value, False, [], None, None

    def feedback(self, value):
        self.told.append(value)

    def finish(self, ending, result):
        assert self.ending is None, "once"
        self.ending, self.result = ending, result


class World:
    """A controller that obeys, a pad in view, velcro that holds; a planner as told. IMU at a rate of its own; lazy inputs in batches."""

    def __init__(self, planner=None, period=10_000_000, params=None, **goal):
        self.mission = Mission(params or MissionParameters())
        self.period, self.stamp, self.clock, self.planner = period, 5 * NANOSECONDS, 900 * NANOSECONDS, planner or self.plan
        self.p, self.q, self.state, self.id = np.zeros(3), LEVEL, ControllerState.DISARMED, 0
        self.flown = self.contact = None
        self.covariance, self.thrust_ratio = NONE, 1.0
        self.imu_frame, self.turn = "imu_link", (1.0, 1.0, 1.0)
        self.requests, self.orders, self.commands, self.lines, self.sees, self.odometry = [], [], [], [], True, True
        self.mission.trajectory.receivers.append(self.fly)
        self.mission.recovery.receivers.append(self.orders.append)
        self.mission.command.receivers.append(self.obey)
        self.mission.log.receivers.append(self.lines.append)
        self.mission.plan_perch = self.mission.plan_powerline = lambda request, due: (self.requests.append((request, due)), self.planner(request))
        self.mission.plan_way_out = lambda request, due: self.mission.on_plan_way_out(request, PerchPlan(success=False, message="none"))
        self.goal = Sent(PerchGoal(**goal))

    def plan(self, request):
        path = rest_to_rest(request.p, SURFACE.p_WS, 0.0, 0.0, 1.2, start_time=seconds(request.start))
        self.mission.on_plan_perch(request, PerchPlan(success=True, message="found", trajectory=path))

    def replan(self, request):
        """The rest of what is flown, in the time that is left."""
        start, duration = seconds(request.start), request.segment_times[0] if request.segment_times else 1.2
        p = request.p if request.current is None else request.current.sample(start - request.current.start_time).p
        path = rest_to_rest(p, SURFACE.p_WS, 0.0, 0.0, duration, start_time=start)
        self.mission.on_plan_perch(request, PerchPlan(success=True, message="found", trajectory=path))

    def fly(self, order):
        self.orders.append(order)
        self.flown, self.state, self.id = order.trajectory, ControllerState.TRACKING, order.id
        self.contact = None if order.at_end == 0 else order.trajectory.start_time + order.trajectory.duration

    def obey(self, command):
        self.commands.append(Command(command.command))
        assert command.stamp == self.stamp
        states = {Command.ARM: ControllerState.ARMED, Command.ATTACHED: ControllerState.ATTACHED, Command.DISARM: ControllerState.DISARMED,
                  Command.HOVER: ControllerState.HOVERING}
        self.state = states.get(self.commands[-1], self.state)

    def tick(self):
        time = seconds(self.stamp)
        if self.flown is not None and time >= self.flown.start_time:
            self.p = self.flown.sample(time - self.flown.start_time).p
        if self.contact is not None and time >= self.contact:
            self.q = tuple(Q_PERCH)
        force = tuple(so3.quat_rotate(so3.quat_conjugate(np.array(self.q)), [0, 0, GRAVITY]).tolist())
        stamps = range(self.stamp - TICK + self.period, self.stamp + 1, self.period)
        for stamp in stamps:
            self.mission.on_imu(ImuSample(stamp, (0.0,) * 3, tuple(f * s for f, s in zip(force, self.turn, strict=True)), self.imu_frame))
        if self.odometry:
            for stamp in stamps:
                self.mission.on_odometry(OdometryState(stamp, tuple(map(float, self.p)), self.q, (0.0,) * 3, (0.0,) * 3, self.covariance, NONE))
        self.mission.on_status(ControllerStatus(self.stamp, int(self.state), "geometric", self.id, 0.0, 0.0, 0.0, 0.0, 1.0, self.thrust_ratio, "says so"))
        self.mission.on_estimator(EstimatorHealth(self.stamp, 1, 0.0, 1, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, ""))
        if self.sees:
            self.mission.on_target(TargetPose(self.stamp - 30_000_000, SURFACE.p_WS, Q_PERCH, 1e-4 * np.eye(6)))
        self.mission.on_tick(self.clock)
        self.stamp, self.clock = self.stamp + TICK, self.clock + TICK

    def run(self, limit=40.0, until=lambda world: False):
        end = self.stamp + limit * 1e9
        while self.goal.ending is None and self.stamp < end and not until(self):
            self.tick()
        return self

    def send(self):
        assert self.mission.on_perch(self.goal) == ""
        return self

    @property
    def phase(self):
        return self.goal.told[-1].phase if self.goal.told else ""

    @property
    def said(self):
        return " | ".join(line.text for line in self.lines)


@pytest.mark.parametrize("period", [1_000_000, 2_000_000, 5_000_000, 10_000_000])
def test_a_perch_from_the_goal_to_its_result_at_any_imu_rate(period):
    world = World(period=period).send().run()
    result = world.goal.result
    assert world.goal.ending == "succeeded" and result.success and result.error_code == 0
    assert world.commands == [Command.ARM, Command.ATTACHED] and result.contact_time == pytest.approx(world.contact + 0.06, abs=0.05)
    np.testing.assert_allclose(result.final_position, SURFACE.p_WS, atol=1e-9)
    assert result.end_time == seconds(world.stamp - TICK)
    assert [o.id for o in world.orders] == [1, 2] and world.orders[1].contact_time == 0.25
    phases = list(dict.fromkeys(f.phase for f in world.goal.told))
    assert phases == ["arming", "take_off", "searching", "planning", "tracking", "verifying", "perched"]
    assert [type(order.trajectory.start_time) for order in world.orders] == [float] * 2


def test_feedback_comes_at_changes_and_every_tenth_of_a_second():
    world = World().send().run(1.0)
    assert 10 <= len(world.goal.told) <= 14


def test_a_vehicle_that_may_be_on_its_perch_is_not_armed_before_the_controller_has_said_so():
    world = World()
    world.state, receive = ControllerState.ATTACHED, world.mission.on_status
    world.mission.on_status = lambda status: None
    world.send().run(0.1)
    assert world.commands == [] and world.goal.told[-1].message == "waiting for the controller"
    world.mission.on_status = receive
    world.run(0.1)
    assert world.commands == [] and world.goal.result.error_code == Result.PERCHED_ALREADY


def test_a_second_goal_goes_on_with_other_numbers():
    world = World().send().run()
    world.goal, world.state, world.flown, world.contact, world.q, world.p = Sent(PerchGoal()), ControllerState.DISARMED, None, None, LEVEL, np.zeros(3)
    world.send().run()
    assert world.goal.ending == "succeeded" and [o.id for o in world.orders] == [1, 2, 3, 4]


def test_an_answer_counts_from_its_due_time_on():
    latency = MissionParameters().mission.planner_latency
    world = World().send().run(until=lambda w: w.requests)
    request, due = world.requests[0]
    asked = world.stamp - TICK
    assert due == asked + round(latency * 1e9) and world.phase == "planning"
    orders = len(world.orders)
    world.run(until=lambda w: len(w.orders) > orders)
    assert world.stamp - TICK == due, "the answer was there at once"
    assert seconds(request.start) == world.orders[-1].trajectory.start_time


@pytest.mark.parametrize("latency", [0.04, 0.15, 0.25])
def test_new_plans_are_flown_however_long_a_plan_takes(latency):
    world = World(params=MissionParameters(mission=MissionSettings(planner_latency=latency)), replan=True)
    world.planner = world.replan
    world.send().run()
    perches = [order.trajectory for order in world.orders if order.at_end]
    assert world.goal.ending == "succeeded" and len(perches) > 2
    ends = [path.start_time + path.duration for path in perches]
    assert ends == pytest.approx([ends[0]] * len(ends), abs=1e-6)
    dues = [due for _, due in world.requests]
    assert np.diff(dues).min() >= latency * NANOSECONDS - 1, "one at a time"


def test_a_new_plan_that_the_controller_refuses_is_not_taken_as_flown():
    class Refusing(World):
        def fly(self, order):
            if order.at_end == 0 or all(other.at_end == 0 for other in self.orders):
                super().fly(order)
            else:
                self.orders.append(order)

    world, ways_out = Refusing(replan=True), []
    world.planner = world.replan
    world.mission.plan_way_out = lambda request, due: world.mission.on_plan_way_out(
        request, PerchPlan(success=True, trajectory=rest_to_rest(np.zeros(3), np.ones(3), 0.0, 0.0, 1.0, start_time=seconds(request.start))))
    world.mission.recovery.receivers[:] = [ways_out.append]
    world.send().run()
    perches = [order for order in world.orders if order.at_end]
    assert len(perches) > 2 and ways_out[-1].id == world.id == perches[0].id
    assert any("the new plan was not accepted: says so" in told.message for told in world.goal.told)
    assert world.goal.ending == "succeeded"


@pytest.mark.parametrize("ratio", [0.83, 0.0])
def test_a_plan_is_asked_for_with_the_thrust_that_the_controller_has_found(ratio):
    world = World()
    world.thrust_ratio = ratio
    world.send().run(until=lambda w: w.requests)
    assert world.requests[0][0].thrust_ratio == ratio


def test_a_late_answer_is_flown_from_when_it_comes():
    world = World(planner=lambda request: None).send().run(until=lambda w: w.requests)
    world.run(0.9)
    assert world.phase == "planning"
    world.plan(world.requests[0][0])
    answered, request = seconds(world.stamp), world.requests[0][0]
    world.run()
    trajectory = world.orders[-1].trajectory
    assert world.goal.ending == "succeeded" and seconds(request.start) < answered < trajectory.start_time < answered + 0.1
    assert world.goal.result.contact_time > trajectory.start_time + trajectory.duration


@pytest.mark.parametrize("answer, said", [
    (Unavailable("service /plan_perch is not there"), "is not there"), (PerchPlan(success=False, message="thrust floor"), "thrust floor"),
    (PerchPlan(success=True, message="forgot the trajectory"), "forgot")])
def test_a_planner_that_is_missing_or_refuses_ends_the_goal(answer, said):
    world = World()
    world.planner = lambda request: world.mission.on_plan_perch(request, answer)
    world.send().run()
    assert (world.goal.ending, world.goal.result.error_code) == ("aborted", Result.REFUSED) and said in world.goal.result.message


@pytest.mark.parametrize("answer", [Unavailable("plan_way_out failed"), PerchPlan(success=False, message="none")])
def test_ways_out_are_asked_for_although_the_planner_has_none_once(answer):
    world, asked = World(), []
    world.mission.plan_way_out = lambda request, due: (asked.append(seconds(request.start)), world.mission.on_plan_way_out(request, answer))
    world.send().run()
    assert world.goal.ending == "succeeded" and len(asked) > 5 and asked == sorted(set(asked))


def test_a_planner_that_never_answers_ends_the_goal():
    world = World(planner=lambda request: None).send().run()
    assert (world.goal.ending, world.goal.result.error_code) == ("aborted", Result.TIMEOUT) and "planner" in world.goal.result.message


def test_an_answer_to_an_earlier_goal_is_not_taken_for_this_ones():
    world = World(planner=lambda request: None).send().run(until=lambda w: w.requests)
    world.goal.cancel_requested = True
    world.run()
    assert world.goal.ending == "cancelled"
    world.goal, world.state = Sent(PerchGoal()), ControllerState.HOVERING
    world.send().run(until=lambda w: len(w.requests) == 2)
    world.plan(world.requests[0][0])
    world.run(0.5)
    assert world.phase == "planning"
    world.plan(world.requests[1][0])
    world.run()
    assert world.goal.ending == "succeeded"


@pytest.mark.parametrize("success", [True, False])
def test_a_late_answer_after_a_timeout_is_not_taken_for_the_next_goals(success):
    world = World(planner=lambda request: None).send().run()
    assert world.goal.result.error_code == Result.TIMEOUT
    world.goal, world.state = Sent(PerchGoal()), ControllerState.HOVERING
    world.send().run(until=lambda w: len(w.requests) == 2)
    orders, late = len(world.orders), world.requests[0][0]
    if success:
        world.plan(late)
    else:
        world.mission.on_plan_perch(late, PerchPlan(success=False, message="late"))
    world.run(0.5)
    assert world.phase == "planning" and len(world.orders) == orders


def test_an_unasked_answer_is_nothing():
    world = World()
    world.plan(type("Request", (), {"p": np.zeros(3), "start": 0}))
    world.send().run(until=lambda w: w.requests)
    assert [order.at_end for order in world.orders] == [0], "the take-off alone"
    world.run()
    assert world.goal.ending == "succeeded" and len(world.orders) == 2


@pytest.mark.parametrize("goal, word", [
    ({"mode": 9}, "mode: 9 is not one of 0 (surface)"), ({"mode": 2}, "waypoints"), ({"mode": 1, "perch_point": (NAN, 0.0, 0.0)}, "perch_point"),
    ({"mode": 1, "perch_pitch": 4.0}, "perch_pitch"), ({"takeoff_height": -1.0}, "takeoff_height"), ({"takeoff_height": math.inf}, "takeoff_height"),
    ({"search_timeout": 0.0}, "search_timeout"), ({"inclination_hint": 9.0}, "inclination_hint"), ({"search_frame": "odom"}, "'odom'"),
    ({"search_frame": "map", "search_position": (NAN, 0.0, 1.0)}, "finite"), ({"search_frame": "map", "search_position": (0.0, 0.0, 0.1)}, "0.3 m"),
    ({"search_frame": "map", "search_attitude": (0.0, 0.0, 0.0, 0.0)}, "is not 1")])
def test_a_goal_that_cannot_be_flown_ends_with_the_reason(goal, word):
    world = World(**goal)
    assert world.mission.on_perch(world.goal) == ""
    assert (world.goal.ending, world.goal.result.error_code) == ("aborted", Result.BAD_GOAL) and word in world.goal.result.message
    world.goal = Sent(PerchGoal())
    world.send().run()
    assert world.goal.ending == "succeeded", "the next one is flown"


def test_a_goal_after_a_cancel_on_the_ground_arms_again_although_the_last_state_is_older_than_the_cancel():
    world = World().send().run(until=lambda w: w.state is ControllerState.ARMED)
    world.goal.cancel_requested = True
    world.run()
    assert world.goal.ending == "cancelled" and world.state is ControllerState.DISARMED
    world.goal, world.state = Sent(PerchGoal()), ControllerState.ARMED
    world.send().tick()
    assert not world.orders and world.commands[-1] is Command.ARM
    world.run()
    assert world.goal.ending == "succeeded"


def test_one_goal_at_a_time():
    world = World().send().run(2.0)
    other = Sent(PerchGoal())
    assert "another goal" in world.mission.on_perch(other) and other.ending is None


@pytest.mark.parametrize("phase", ["take_off", "planning", "tracking"])
def test_a_goal_is_cancelled_in_flight(phase):
    """In every phase: `test_mission.py`."""
    world = World().send().run(until=lambda w: w.phase == phase)
    world.goal.cancel_requested = True
    world.run()
    assert world.goal.ending == "cancelled" and world.goal.result.error_code == Result.CANCELLED


def test_without_any_odometry_a_goal_is_cancelled_or_given_up():
    for cancelled, ending, code in ((True, "cancelled", Result.CANCELLED), (False, "aborted", Result.TIMEOUT)):
        world = World()
        world.odometry = False
        world.send().run(1.0)
        assert world.goal.ending is None
        world.goal.cancel_requested = cancelled
        world.run()
        assert (world.goal.ending, world.goal.result.error_code) == (ending, code)


def test_where_odometry_stops_the_hosts_time_goes_on():
    world = World().send().run(until=lambda w: w.phase == "searching")
    world.odometry, world.sees = False, False
    began = world.stamp
    world.run(60.0)
    assert world.goal.result is not None and world.goal.result.error_code == Result.NOT_FOUND
    assert world.stamp - began < 15 * NANOSECONDS


@pytest.mark.parametrize("odometry", [True, False])
def test_an_estimator_that_has_fallen_silent_is_not_ready_to_depart(odometry):
    world, replies = World(), []
    world.state = ControllerState.ATTACHED
    world.run(0.5)
    world.mission.on_estimator, world.odometry = lambda health: None, odometry
    world.run(1.5)
    world.mission.on_depart(TriggerRequest(), replies.append)
    world.run(world.mission.config.mission.phase_timeout + 1.0)
    assert not world.commands and not replies[0].success and "the estimator is not ready" in replies[0].message


def test_ticks_without_new_odometry_do_nothing():
    world, decided = World().send().run(1.0), []
    decide = world.mission._decide
    world.mission._decide = lambda *inputs: decided.append(inputs) or decide(*inputs)
    for k in range(20):
        world.mission.on_tick(world.clock - TICK + k * 1_000_000)
    assert not decided
    world.tick()
    assert len(decided) == 1


# -- bad input ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("changes, word", [
    ({"p_WS": np.full(3, NAN)}, "finite"), ({"q_WS": np.zeros(4)}, "norm"), ({"q_WS": np.full(4, NAN)}, "norm"), ({"p_WS": np.zeros(2)}, "shape"),
    ({"covariance": np.full((6, 6), NAN)}, "finite"), ({"covariance": -np.eye(6)}, "covariance"), ({"covariance": np.eye(3)}, "9 entries"),
    ({"stamp": 10**15}, "future"), ({"stamp": 1}, "older")])
def test_a_foreign_target_is_refused_and_does_not_stop_the_flight(changes, word):
    world = World().send().run(until=lambda w: w.phase == "searching")
    foreign = TargetPose(world.stamp, np.array([9.0, 9.0, 9.0]), np.array(LEVEL), 1e-6 * np.eye(6))._replace(**changes)
    while world.goal.ending is None and world.stamp < 60 * NANOSECONDS:
        world.mission.on_target(foreign)
        world.tick()
    assert world.goal.ending == "succeeded" and word in world.said
    np.testing.assert_allclose(world.goal.result.final_position, SURFACE.p_WS, atol=1e-9)


def test_a_contact_is_felt_by_an_imu_in_other_axes():
    world = World()
    world.imu_frame, world.turn = "fcu_imu", (1.0, -1.0, -1.0)
    world.mission.on_transform(Transform("base_link", "fcu_imu", (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)))
    assert world.send().run().goal.ending == "succeeded"


@pytest.mark.parametrize("frame, said", [("elsewhere", True), ("base_link", False), ("", False)])
def test_imu_samples_in_axes_that_are_not_known_are_ignored_with_a_word(frame, said):
    world = World().send().run(until=lambda w: w.phase == "searching")
    world.mission.on_imu(ImuSample(world.stamp, (0.0,) * 3, (0.0, 0.0, 9.8), frame))
    assert (f"imu/data_raw: frame {frame!r}" in world.said) == said


def test_a_target_before_any_odometry_is_not_believed():
    world = World()
    world.sees = False
    world.mission.on_target(TargetPose(world.stamp, SURFACE.p_WS, Q_PERCH, 1e-4 * np.eye(6)))
    assert "target/pose refused" in world.said
    world.send().run()
    assert world.goal.result.error_code == Result.NOT_FOUND and not world.requests


@pytest.mark.parametrize("sigma, grown, found", [(3.0, 0.0, True), (3.0, 0.2, False)])
def test_of_the_odometrys_uncertainty_only_what_has_come_since_the_sighting_counts(sigma, grown, found):
    """Metres of drift since take-off move vehicle and pad alike; what comes after the pad was last seen does not."""
    world = World()
    world.covariance = sigma**2 * np.eye(6)
    world.send().run(until=lambda w: w.phase == "searching").run(0.1)  # seen since then
    world.sees, world.covariance = False, (sigma**2 + grown**2) * np.eye(6)
    world.run()
    assert world.goal.ending == ("succeeded" if found else "aborted")
    assert found or "position uncertain by" in world.goal.result.message


@pytest.mark.parametrize("odometry", [
    {"p_WB": (NAN, 0.0, 0.0)}, {"q_WB": (0.0,) * 4}, {"frame": "odom"}, {"v_B": (1e300, 0.0, 0.0)}, {"stamp": 10**17}, {"stamp": 0}])
def test_foreign_odometry_imu_and_states_are_ignored(odometry):
    world = World().send()
    while world.goal.ending is None and world.stamp < 60 * NANOSECONDS:
        state = OdometryState(world.stamp, (5.0, 5.0, 5.0), LEVEL, (0.0,) * 3, (0.0,) * 3, NONE, NONE)
        if world.stamp > 6 * NANOSECONDS:
            world.mission.on_odometry(state._replace(**odometry))
            world.mission.on_imu(ImuSample(world.stamp, (0.0,) * 3, (NAN, 0.0, 0.0)))
            world.mission.on_status(ControllerStatus(0, 6, "", 0, NAN, NAN, NAN, NAN, NAN, NAN, "failed long ago"))
            world.mission.on_status(ControllerStatus(world.stamp, 200, "", 0, NAN, NAN, NAN, NAN, NAN, NAN, "no state"))
            world.mission.on_estimator(EstimatorHealth(0, 3, NAN, 0, 0, NAN, (NAN,) * 3, (NAN,) * 3, NAN, NAN, ""))
        world.tick()
    assert world.goal.ending == "succeeded" and ("ignored" in world.said or "odometry: " in world.said)


@pytest.mark.parametrize("older", [TICK, 2 * NANOSECONDS, -3600 * NANOSECONDS])
def test_states_that_were_overtaken_do_not_undo_the_newer_ones_and_one_of_the_future_keeps_out_no_other(older):
    class Reordered(World):
        def tick(self):
            super().tick()
            if self.phase in ("verifying", "perched"):
                self.mission.on_status(ControllerStatus(self.stamp - TICK - older, int(ControllerState.TRACKING), "", 1, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0, "old"))
                self.mission.on_estimator(EstimatorHealth(self.stamp - TICK - older, 2, 9.0, 1, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, ""))

    world = Reordered().send().run()
    assert world.goal.ending == "succeeded"
    assert ("controller/status: stamp" in world.said) == (older > 0)


def test_a_vehicle_that_was_started_again_ends_the_goal_and_takes_the_next():
    world = World().send().run(3.0)
    world.stamp, world.p, world.flown, world.state = NANOSECONDS, np.zeros(3), None, ControllerState.DISARMED
    world.run(2.0)
    assert world.goal.ending == "aborted" and "restarted" in world.goal.result.message
    world.goal = Sent(PerchGoal())
    world.send().run()
    assert world.goal.ending == "succeeded"


@pytest.mark.parametrize("back", [60_000_000, 150_000_000, 300_000_000])
def test_a_clock_that_is_set_back_a_little_costs_no_goal(back):
    world = World().send().run(3.0)
    world.stamp -= back
    assert world.run().goal.ending == "succeeded"


@pytest.mark.parametrize("period", [2_000_000, 10_000_000])
def test_a_clock_that_was_set_ahead_between_goals_costs_no_goal(period):
    world = World(period=period).run(0.2)
    world.stamp += 10 * NANOSECONDS
    world.run(0.2)
    assert "not current" in world.said and world.send().run().goal.ending == "succeeded"


# -- powerlines --------------------------------------------------------------------------------------------------------


LINE = MappedPowerline(4, (4.0, -2.0, 4.25), (4.0, 2.0, 4.25), 0.01, 1e-4 * np.eye(3), 0.01, 30)


class Wires(World):
    """The same with a mapped wire in the place of the pad."""

    def __init__(self, **goal):
        super().__init__(mode=1, perch_point=(4.0, 0.0, 4.2), perch_pitch=1.4, takeoff_height=4.2, **goal)
        self.sees, self.line, self.changes = False, LINE, {}

    def plan(self, request):
        t = np.linspace(0.0, 3.0, 60)
        zero = np.zeros((60, 3))
        q = np.tile([0.0, 0.0, 0.0, 1.0004], (60, 1))
        sampled = SampledTrajectory(t, np.tile(request.p, (60, 1)), q, zero, zero, zero, zero, np.ones((60, 4)), seconds(request.start))
        plan = PowerlinePlan(
            success=True, message="", trajectory=sampled, at_end=0 if request.recovery_only else 3, recovery_start=0.0 if request.recovery_only else 2.0,
            perch_time=0.0 if request.recovery_only else 2.0, recovery_time=1.0)
        self.mission.on_plan_powerline(request, replace(plan, **self.changes))

    def tick(self):
        self.mission.on_powerlines(PowerlineMap(self.stamp - 40_000_000, (self.line,), False, ""))
        super().tick()


def test_a_wire_is_asked_for_flown_and_left_by_ways_out():
    world = Wires(perception_aware=True).send().run(60.0, until=lambda w: len(w.requests) > 3)
    first, way_out = world.requests[0][0], world.requests[1][0]
    assert first.lines == (LINE,) and first.target_line == 4 and not first.recovery_only and first.perception_aware and first.with_recovery
    assert first.rotor_thrust == () and first.perch_pitch == pytest.approx(1.4)
    assert way_out.recovery_only and len(way_out.rotor_thrust) == 4 and np.linalg.norm(way_out.q) == pytest.approx(1.0)
    perch = next(o for o in world.orders if o.at_end == 3)
    assert perch.recovery_start == 2.0 and np.linalg.norm(perch.trajectory.q[0]) == pytest.approx(1.0004), "as planned: the controller normalises"
    assert any(o.at_end == 0 and isinstance(o.trajectory, SampledTrajectory) and o.id == perch.id for o in world.orders), "a way out, of the same number"


@pytest.mark.parametrize("left, message", [
    (0.35, "cancelled"), (0.2, "cancelled too late, unless the gripper fails: the contact may come at any moment")])
def test_cancelled_when_no_way_out_is_left_the_wire_is_the_goals_end_unless_the_gripper_fails(left, message):
    world = Wires().send().run(60.0, until=lambda w: any(o.at_end == 3 for o in w.orders))
    contact = next(o.trajectory.start_time + 2.0 for o in world.orders if o.at_end == 3)
    world.run(until=lambda w: seconds(w.stamp) > contact - left)
    world.goal.cancel_requested = True
    world.run(0.05)
    assert world.goal.told[-1].message == message
    assert world.commands[-1] is Command.HOVER, "the recovery follows where the gripper has not closed"


def test_cancelled_when_no_way_out_is_left_a_surface_is_the_goals_end():
    world = World().send().run(until=lambda w: w.contact is not None)
    world.run(until=lambda w: seconds(w.stamp) > w.contact - 0.05)
    world.goal.cancel_requested = True
    world.run(0.02)
    assert world.goal.told[-1].message.startswith("cancelled too late: ")
    world.run()
    assert Command.HOVER not in world.commands and world.goal.ending == "cancelled"
    assert world.goal.result.message.startswith("cancelled too late: perched")


PATH = rest_to_rest(np.zeros(3), SURFACE.p_WS, 0.0, 0.0, 3.0, start_time=20.0)
NOWHERE = SampledTrajectory(np.array([0.0, 3.0]), *(np.zeros((2, width)) for width in (3, 4, 3, 3, 3, 3, 4)), start_time=20.0)


@pytest.mark.parametrize("changes, word", [
    ({"at_end": 7}, "at_end: 7 is outside"), ({"perch_time": NAN}, "perch after nan s"), ({"perch_time": 1e9}, "perch after 1e+09 s"),
    ({"recovery_start": math.inf}, "recovery_start"), ({"trajectory": PATH}, "trajectory: polynomials"),
    ({"trajectory": NOWHERE}, "quaternion of sample 0 has norm 0.0000")])
def test_an_invalid_plan_is_refused_with_the_reason(changes, word):
    world = Wires()
    world.changes = changes
    world.send().run(60.0)
    assert world.goal.result.error_code == Result.REFUSED and f"planner refused: invalid plan: {word}" in world.goal.result.message


def test_an_invalid_plan_for_a_surface_is_refused_with_the_reason():
    world = World()
    far = replace(PATH, coefficients=PATH.coefficients + 1e5)
    world.planner = lambda request: world.mission.on_plan_perch(request, PerchPlan(success=True, trajectory=far))
    world.send().run()
    assert world.goal.result.error_code == Result.REFUSED and "invalid plan: trajectory: " in world.goal.result.message


@pytest.mark.parametrize("line", [
    LINE._replace(start=(NAN, 0.0, 0.0)), LINE._replace(end=LINE.start), LINE._replace(radius=-1.0), LINE._replace(covariance=np.full((3, 3), NAN)),
    LINE._replace(covariance=np.eye(6)), LINE._replace(direction_sigma=NAN)])
def test_a_map_with_a_line_that_is_none_is_refused(line):
    world = Wires().send()
    world.line = line
    world.run(2.0)
    assert "powerlines" in world.said and "refused" in world.said
    world.mission.on_powerlines(PowerlineMap(10**15, (LINE,), False, ""))
    assert "future" in world.said


def test_a_map_with_two_lines_of_one_id_is_refused():
    world = Wires()
    world.tick()
    world.mission.on_powerlines(PowerlineMap(world.stamp, (LINE, LINE._replace(start=(5.0, -2.0, 4.25), end=(5.0, 2.0, 4.25))), False, ""))
    assert "powerlines refused: two lines have the id 4" in world.said


def test_settings_change_in_flight():
    world = World().send().run(until=lambda w: w.phase == "searching")
    config = world.mission.config
    world.mission.reconfigure(replace(config, mission=replace(config.mission, contact_time=0.4)))
    world.run()
    assert world.goal.ending == "succeeded" and world.orders[-1].contact_time == 0.4


@pytest.mark.parametrize("phase", ["take_off", "searching", "tracking"])
def test_a_controller_that_falls_silent_ends_the_goal_within_a_second_and_a_half(phase):
    world = World().send().run(until=lambda w: w.phase == phase)
    world.mission.on_status, silent = lambda status: None, world.stamp
    result = world.run().goal.result
    assert (world.goal.ending, result.error_code) == ("aborted", int(Result.TRACKING_LOST)) and "the controller is silent" in result.message
    assert world.stamp - silent < 1.5 * NANOSECONDS


# -- hung nodes --------------------------------------------------------------------------------------------------------


def overdue(world, within=5.0):
    """What the feedback names within a time [s] from now."""
    before = len(world.goal.told)
    for _ in range(round(within / 0.02)):
        if world.goal.ending is None:
            world.tick()
    return " | ".join(dict.fromkeys(f.message for f in world.goal.told[before:]))


def never(world, *names):
    """From now on, the named inputs of the mission do not come."""
    for name in names:
        setattr(world.mission, f"on_{name}", lambda value: None)
    return world


@pytest.mark.parametrize("silent, owed", [
    (["imu", "odometry", "estimator", "status"], "no imu/data_raw from vehicle, no odometry from estimator, no estimator/status from estimator, "
                                                 "no controller/status from controller for 3 s"),
    (["odometry", "estimator"], "no odometry from estimator, no estimator/status from estimator for 3 s"), (["odometry"], "no odometry from estimator for 3 s"),
    (["estimator"], "no estimator/status from estimator for 3 s"),
    (["status"], "no controller/status from controller for 3 s")])
def test_before_the_take_off_what_is_awaited_is_named_in_feedback_and_result(silent, owed):
    world = never(World(), *silent).send()
    assert owed in overdue(world) and world.phase == "arming"
    world.run()
    assert world.goal.result.error_code == Result.TIMEOUT and owed in world.goal.result.message


def test_an_estimator_that_waits_for_vio_owes_nothing_itself():
    world, receive = World(), Mission.on_estimator
    world.odometry = False
    world.mission.on_estimator = lambda health: receive(world.mission, health._replace(state=0, vio_age=math.inf))
    assert "no odometry from estimator, no vio/odometry from vio for 3 s" in overdue(world.send())


@pytest.mark.parametrize("silent, owed", [
    (["imu"], "no imu/data_raw from vehicle, "), (["odometry"], "no odometry from estimator, "), (["estimator"], "no estimator/status from estimator, "),
    ([], "")])
def test_in_flight_what_has_stopped_is_named(silent, owed):
    world = never(World(), "target").send().run(until=lambda w: w.phase == "searching")
    assert f"(no tags detected); {owed}no target/pose from target_localizer for 3 s" in overdue(never(world, *silent))


def test_a_map_that_does_not_come_is_named():
    world = never(Wires(), "powerlines").send().run(until=lambda w: w.phase == "searching")
    assert "no powerlines from powerline_mapper for 3 s" in overdue(world)


@pytest.mark.parametrize("world, owed", [(World, "no plan_perch from perching_planner for 3 s"), (Wires, "no plan_powerline from powerline_planner for 3 s")])
def test_a_planner_that_does_not_answer_is_named(world, owed):
    world = world(planner=lambda request: None) if world is World else world()
    world.planner = lambda request: None
    world.send().run(until=lambda w: w.phase == "planning")
    assert f"planning; {owed}" in overdue(world)
    world.run()
    assert world.goal.result.error_code == Result.TIMEOUT and owed in world.goal.result.message


@pytest.mark.parametrize("phase", ["", "searching"])
def test_where_simulated_time_stands_still_the_vehicle_is_named(phase):
    world = World() if phase else never(World(), "imu", "odometry", "estimator", "status")
    world.send().run(until=lambda w: w.phase == phase)
    for _ in range(250):
        world.mission.on_tick(world.clock)
    assert "no /clock from vehicle" in world.goal.told[-1].message and "no odometry from estimator" in world.goal.told[-1].message


def test_a_flight_in_which_everything_comes_names_nothing():
    world = World().send().run()
    assert not [f for f in world.goal.told if "from" in f.message] and world.goal.result.message == "perched"
