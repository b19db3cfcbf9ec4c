"""The mission against a small model of controller, planner and pad: every phase, every ending."""

import math

import numpy as np
import pytest

from perch_core import so3
from perch_core.surface import PerchSurface
from perch_core.trajectory import rest_to_rest
from perch_core.values import MappedPowerline
from perch_core.vehicle import GRAVITY
from perch_control.mission import (
    AdhesionMonitor, Command, ControllerState, Goal, Inputs, MissionSettings, Outputs, Phase,
    Plan, Refusal, Result, State, SurfaceMission, Target)
from perch_control.mission.departure import Departure
from perch_control.mission.moves import Moves

TICK = 0.02
SURFACE = PerchSurface.from_inclination(np.array([1.7, 0.0, 1.2]), math.pi / 2)
Q_PERCH = so3.quat_from_matrix(SURFACE.R_WS)


class World:
    """What the mission sees: a controller that obeys, a pad that is visible or not, velcro that holds or not."""

    def __init__(self, sees=True, plans=True, sticks=True, stays=True, recovers=True, ready=True, detour=0.0, takes=True):
        self.detour, self.flown = detour, []  # what a new plan's contact is late by [s]; starts and durations of perches
        self.sees, self.plans, self.sticks, self.stays, self.recovers, self.ready = sees, plans, sticks, stays, recovers, ready
        self.machine = SurfaceMission(MissionSettings())
        self.takes, self.due = takes, None  # whether the controller takes perches; start and id of the one that waits
        self.deaf = self.lost_attached = 0  # so many commands to arm, and messages that the vehicle is attached, are lost
        self.time, self.p, self.q = 0.0, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0])
        self.controller, self.trajectory_id = ControllerState.DISARMED, 0
        self.reference = self.perch_end = self.query = None
        self.stuck, self.off_at, self.commands, self.outcome, self.queries, self.ways_out_asked = False, None, [], None, 0, 0

    def force(self):
        """Specific force in B: carried at rest, by thrust alone on the perch, by nothing with motors off in the air."""
        g_B = so3.quat_rotate(so3.quat_conjugate(self.q), [0, 0, GRAVITY])
        if self.off_at is not None and not self.stays and self.time > self.off_at + 0.1:
            return np.zeros(3)
        if np.allclose(self.q, Q_PERCH) and not self.stuck:
            return np.array([0.0, 0.0, 3.3])
        return g_B

    def tick(self, cancel=False):
        assert self.time < 1000.0, f"what is waited for does not come: {self.machine.phase}, {self.machine.message}"
        if self.reference is not None and self.time >= self.reference.start_time:
            self.p = self.reference.sample(self.time - self.reference.start_time).p
        if self.due is not None and self.time >= self.due[0]:
            self.controller, self.trajectory_id, self.due = ControllerState.TRACKING, self.due[1], None
        if self.perch_end is not None and self.time >= self.perch_end:
            self.p, self.q, self.stuck = SURFACE.p_WS, Q_PERCH, self.sticks
            if not self.sticks and self.time > self.perch_end + 0.25 and self.recovers:
                self.controller, self.q = ControllerState.RECOVERING, np.array([0.0, 0.0, 0.0, 1.0])
                self.perch_end, self.hover_at = None, self.time + 1.0
        if self.controller is ControllerState.RECOVERING and self.time > self.hover_at:
            self.controller = ControllerState.HOVERING
        plan = None
        if self.query is not None:
            plan = Refusal("thrust floor 5.2 N > 4.05 N") if not self.plans else Plan(
                rest_to_rest(np.zeros(3), np.zeros(3), 0.0, 0.0, 1.0, self.query.start_time),
                1.2 if self.query.duration is None else self.query.duration + self.detour)
            self.query = None
        target = Target(self.time, SURFACE.p_WS, Q_PERCH, 0.01, 0.01) if self.sees and self.time > 2.0 else None
        falling = 0.0 if self.off_at is None or self.stays else max(self.time - self.off_at - 0.1, 0.0)
        out = self.machine.tick(Inputs(
            self.time, State(self.p, self.q, np.array([0.0, 0.0, -GRAVITY * falling]), np.zeros(3)), self.ready, self.controller, "says so",
            self.trajectory_id, target, np.tile(self.force(), (10, 1)), plan, cancel))
        for command, _ in out.commands:
            self.commands.append(command)
            if command is Command.ARM and self.deaf:
                self.deaf -= 1
            elif command is Command.ARM and self.controller is ControllerState.ATTACHED:
                self.controller, self.hover_at, self.perch_end = ControllerState.RECOVERING, self.time + 1.0, None
                self.q, self.off_at = np.array([0.0, 0.0, 0.0, 1.0]), None
            elif command is Command.ARM:
                self.controller = ControllerState.ARMED
            elif command is Command.HOVER and self.controller is not ControllerState.ATTACHED:
                self.controller, self.hover_at, self.perch_end, self.due = ControllerState.RECOVERING, self.time + 1.0, None, None
                self.q, self.off_at = np.array([0.0, 0.0, 0.0, 1.0]), None
            elif command is Command.ATTACHED and self.lost_attached:
                self.lost_attached -= 1
            elif command is Command.ATTACHED:
                self.controller, self.off_at = ControllerState.ATTACHED, self.time
            elif command is Command.DISARM:
                self.controller = ControllerState.DISARMED
        if out.reference is not None:
            self.reference, self.controller, self.trajectory_id = out.reference, ControllerState.TRACKING, out.trajectory_id
        if out.perch is not None:
            self.flown.append((out.perch.start_time, out.perch.duration))
            if not self.takes:
                self.controller = ControllerState.HOVERING
            elif self.controller in (ControllerState.TRACKING, ControllerState.HOVERING):
                self.reference, self.perch_end, self.due = None, out.perch.start_time + out.perch.duration, (out.perch.start_time, out.trajectory_id)
        if out.query is not None:
            self.query, self.queries = out.query, self.queries + 1
        self.outcome = out.outcome or self.outcome
        self.ways_out_asked += out.way_out_query is not None
        self.time += TICK
        return out

    def run(self, goal=None, seconds=90.0, cancel_in=None):
        self.machine.start(goal or Goal(takeoff_height=1.2, search_timeout=6.0), self.time)
        phases = []
        while self.outcome is None and self.time < seconds:
            self.tick(cancel=cancel_in is not None and cancel_in in phases)
            if not phases or phases[-1] is not self.machine.phase:
                phases.append(self.machine.phase)
        return phases


    def recover(self):
        """The controller leaves what it flies, for a hover."""
        self.controller, self.hover_at, self.perch_end, self.due = ControllerState.RECOVERING, self.time + 0.5, None, None


def reached(phase: Phase, attempts: int = 1, replan: bool = False) -> World:
    """A goal that has come to a phase."""
    world = World()
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0, attempts=attempts, replan=replan), world.time)
    while world.machine.phase is not phase:
        world.tick()
    return world


def test_a_perch_passes_through_every_phase():
    world = World()
    phases = world.run()
    assert world.outcome.result is Result.PERCHED
    assert phases == [Phase.ARMING, Phase.TAKE_OFF, Phase.SEARCHING, Phase.PLANNING, Phase.TRACKING, Phase.VERIFYING,
                      Phase.PERCHED, Phase.IDLE]
    assert world.commands == [Command.ARM, Command.ATTACHED]
    assert world.outcome.contact_time == pytest.approx(world.off_at)


def test_a_controller_that_flies_on_is_told_again_that_the_vehicle_is_attached():
    world = World()
    world.lost_attached = 2
    world.run()
    assert world.outcome.result is Result.PERCHED
    assert world.commands == [Command.ARM] + 3 * [Command.ATTACHED]


def test_a_command_to_arm_that_is_lost_is_given_again():
    world = World()
    world.deaf = 2
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is Phase.ARMING:
        world.tick()
    assert world.commands == 3 * [Command.ARM] and 2.0 <= world.time < 2.5


@pytest.mark.parametrize("height", [0.0, 0.8])
def test_a_vehicle_that_hovers_elsewhere_has_not_arrived(height):
    """The controller has given up the way, by a recovery that was over before the mission looked."""
    world = World()
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is not Phase.TAKE_OFF:
        world.tick()
    world.reference, world.controller, world.p = None, ControllerState.HOVERING, np.array([0.0, 0.0, height])
    while world.outcome is None and world.time < 20.0:
        world.tick()
    assert world.outcome.result is Result.MISSED and world.queries == 0
    assert "left the way to the search place: says so; recovered to a hover" in world.outcome.message


def test_a_goal_in_the_air_waits_for_the_estimator():
    """One that was just restarted may not know where the vehicle is."""
    world = World(ready=False)
    world.controller, world.p = ControllerState.HOVERING, np.array([0.0, 0.0, 1.2])
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    for _ in range(50):
        world.tick()
    assert world.machine.phase is Phase.ARMING and world.reference is None
    world.ready = True
    world.tick()
    assert world.machine.phase is Phase.TAKE_OFF and world.commands == []
    np.testing.assert_allclose(world.reference.sample(0.0).p, world.p)


def test_motors_stay_on_until_adhesion_is_felt():
    world = World(sticks=False)
    world.run()
    assert world.outcome.result is Result.MISSED and "recovered to a hover" in world.outcome.message
    assert Command.ATTACHED not in world.commands
    assert world.controller is ControllerState.HOVERING


def test_a_replanned_perch_keeps_its_contact_time():
    world = World()
    world.run(Goal(takeoff_height=1.2, search_timeout=6.0, replan=True))
    assert world.outcome.result is Result.PERCHED
    assert len(world.flown) > 2 and world.queries > 2
    assert np.ptp([start + duration for start, duration in world.flown]) < 1e-9


def test_a_replanned_detour_is_not_flown():
    world = World(detour=0.5)
    world.run(Goal(takeoff_height=1.2, search_timeout=6.0, replan=True))
    assert world.outcome.result is Result.PERCHED
    assert world.queries > 2 and len(world.flown) == 1


def test_a_second_attempt_is_flown():
    world = World(sticks=False)
    world.run(Goal(takeoff_height=1.2, search_timeout=6.0, attempts=2))
    assert world.queries == 2 and world.outcome.result is Result.MISSED
    assert world.ways_out_asked == 2, "in the second attempt too, though the first query was never answered"


def test_coming_off_after_the_motors_stopped_is_noticed():
    world = World(stays=False)
    world.run()
    assert world.commands == [Command.ARM, Command.ATTACHED, Command.ARM, Command.HOVER]
    assert world.outcome.result is Result.MISSED


def test_a_vehicle_that_comes_off_is_armed_until_the_controller_flies():
    world = World(stays=False)
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is not Phase.PERCHED:
        world.tick()
    world.deaf = 3
    while world.outcome is None:
        world.tick()
    assert world.commands == [Command.ARM, Command.ATTACHED, Command.ARM, Command.HOVER] + 3 * [Command.ARM]
    assert world.outcome.result is Result.MISSED and world.controller is ControllerState.HOVERING


def test_a_vehicle_that_cannot_be_armed_after_it_came_off_ends_the_goal_with_the_reason():
    world = World(stays=False)
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is not Phase.PERCHED:
        world.tick()
    world.deaf = 10_000
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.TRACKING_LOST and "(says so)" in world.outcome.message
    assert world.commands.count(Command.HOVER) == 1


def test_motors_that_were_started_because_the_vehicle_came_off_are_not_stopped_again():
    world = reached(Phase.PERCHED)
    world.tick()
    world.machine._stopped_at, world.deaf = world.p + (0.0, 0.0, 0.3), 1  # it has slid
    while world.machine.phase is Phase.PERCHED:
        world.tick()
    world.tick()
    assert world.machine.phase is Phase.RECOVERING and world.controller is ControllerState.RECOVERING
    assert Command.ATTACHED not in world.commands[2:]


WIRE = Target(0.0, SURFACE.p_WS, Q_PERCH, 0.01, 0.01, (MappedPowerline(4, (1.7, -2.0, 1.2), (1.7, 2.0, 1.2), 0.01, 1e-4 * np.eye(3), 0.01, 30),), 4)


@pytest.mark.parametrize("cancel_in", [None, Phase.PERCHED])
def test_what_was_perched_on_last_is_left_by_its_own_way(cancel_in):
    world, moves = World(), Moves(MissionSettings())
    moves.wire = WIRE  # of the perch before
    world.machine = SurfaceMission(MissionSettings(), moves=moves)
    world.run(cancel_in=cancel_in)
    assert world.controller is ControllerState.ATTACHED and moves.wire is None


def test_a_departure_without_a_plan_arms_until_the_controller_does():
    world, moves = World(plans=False), Moves(MissionSettings())
    world.controller, moves.wire, world.deaf = ControllerState.ATTACHED, WIRE, 2
    world.machine = Departure(MissionSettings(), moves=moves)
    world.run(seconds=15.0)
    assert world.outcome.result is Result.PERCHED and world.controller is ControllerState.HOVERING
    assert world.commands == 3 * [Command.ARM] and world.queries == 1


@pytest.mark.parametrize("answers, within, said", [(True, 1.2, "the controller has not accepted it: says so"), (False, 6.1, "the planner has not answered")])
def test_a_departure_whose_plan_is_not_flown_arms(answers, within, said):
    moves, time, out, query = Moves(MissionSettings()), 0.0, Outputs(), None
    moves.wire = WIRE
    machine = Departure(MissionSettings(), moves=moves)
    machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), time)
    while not out.commands and time < 15.0:
        plan = Plan(rest_to_rest(np.zeros(3), np.ones(3), 0.0, 0.0, 1.0, time), 1.0) if answers and query is not None else None
        out = machine.tick(Inputs(time, State(SURFACE.p_WS, Q_PERCH, np.zeros(3), np.zeros(3)), True, ControllerState.ATTACHED, "says so", 0, None,
                                  np.zeros((0, 3)), plan))
        query, time = out.query, time + TICK
    assert [command for command, _ in out.commands] == [Command.ARM] and time < within and machine.message.endswith(said)


def test_a_departure_waits_until_the_state_of_the_controller_is_known():
    machine, out = Departure(MissionSettings()), Outputs()
    machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), 0.0)
    for k, (state, known) in enumerate(((ControllerState.DISARMED, -np.inf), (ControllerState.ATTACHED, 0.02))):
        assert out.outcome is None and not out.commands
        out = machine.tick(Inputs(k * TICK, State(SURFACE.p_WS, Q_PERCH, np.zeros(3), np.zeros(3)), True, state, "says so", 0, None,
                                  np.zeros((0, 3)), controller_time=known))
    assert [command for command, _ in out.commands] == [Command.ARM]


def test_a_landing_on_the_way_of_a_departure_ends_it_with_what_the_controller_says():
    moves, query = Moves(MissionSettings()), None
    moves.wire = WIRE
    machine = Departure(MissionSettings(), moves=moves)
    machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), 0.0)
    for k, state in enumerate((ControllerState.ATTACHED, ControllerState.ATTACHED, ControllerState.TRACKING, ControllerState.LANDING)):
        plan = Plan(rest_to_rest(np.zeros(3), np.ones(3), 0.0, 0.0, 1.0, k * TICK), 1.0) if query is not None else None
        out = machine.tick(Inputs(k * TICK, State(SURFACE.p_WS, Q_PERCH, np.zeros(3), np.zeros(3)), True, state, "no odometry", 0, None,
                                  np.zeros((0, 3)), plan))
        query = out.query
    assert out.outcome.result is Result.TRACKING_LOST and out.outcome.message == "controller descends: no odometry"


def test_a_target_that_was_lost_has_to_be_in_view_for_as_long_again():
    world = reached(Phase.SEARCHING)
    while world.machine.message != "target in view":
        world.tick()
    for _ in range(10):
        world.tick()
    world.sees = False
    world.tick()
    world.sees, again = True, world.time
    while world.queries == 0:
        world.tick()
    assert world.time - again > world.machine.settings.target_settle


def test_no_target_ends_in_a_hover_after_the_pattern():
    world = World(sees=False)
    world.run()
    assert world.outcome.result is Result.NOT_FOUND and "no tags detected" in world.outcome.message
    assert world.controller is ControllerState.TRACKING  # still holding the end of the last search move


def test_a_refusal_is_passed_on():
    world = World(plans=False)
    world.run()
    assert world.outcome.result is Result.REFUSED and "thrust floor 5.2 N" in world.outcome.message


def test_an_estimator_that_never_starts_ends_on_the_ground():
    world = World(ready=False)
    world.run()
    assert world.outcome.result is Result.TIMEOUT and "estimator" in world.outcome.message
    assert Command.ARM not in world.commands


def test_a_hint_that_does_not_fit_is_reported():
    world = World()
    world.run(Goal(takeoff_height=1.2, search_timeout=4.0, inclination_hint=math.radians(45)))
    assert world.outcome.result is Result.NOT_FOUND and "expected 45 deg" in world.outcome.message


@pytest.mark.parametrize("phase", [Phase.ARMING, Phase.TAKE_OFF, Phase.SEARCHING, Phase.PLANNING, Phase.TRACKING,
                                   Phase.VERIFYING, Phase.PERCHED])
def test_cancel_works_in_every_phase(phase):
    world = World()
    world.run(cancel_in=phase)
    assert world.outcome.result is Result.CANCELLED
    on_ground = phase is Phase.ARMING
    attached = phase in (Phase.VERIFYING, Phase.PERCHED)  # there is no way out any more
    assert world.controller is (
        ControllerState.DISARMED if on_ground else ControllerState.ATTACHED if attached else ControllerState.HOVERING)


def test_a_cancel_on_the_perch_of_an_earlier_goal_changes_nothing():
    world = World()
    world.controller = ControllerState.ATTACHED
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    world.tick(cancel=True)
    assert world.outcome.result is Result.CANCELLED and world.outcome.message == "cancelled; perched as before" and not world.commands


def test_a_vehicle_that_comes_off_after_a_cancel_is_started_all_the_same():
    world = World(stays=False)
    world.run(cancel_in=Phase.PERCHED)
    assert world.commands[-2:] == [Command.ARM, Command.HOVER]
    assert world.outcome.result is Result.CANCELLED and world.controller is ControllerState.HOVERING


def test_after_a_cancel_the_motors_of_an_attached_vehicle_stop_even_if_a_message_is_lost():
    world = World()
    world.lost_attached = 1
    world.run(cancel_in=Phase.PERCHED)
    assert world.outcome.result is Result.CANCELLED and world.controller is ControllerState.ATTACHED


def test_an_armed_vehicle_takes_off_when_the_estimator_is_ready():
    world = World(ready=False)
    world.controller = ControllerState.ARMED
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    world.tick()
    assert world.machine.phase is Phase.ARMING
    world.ready = True
    world.tick()
    assert world.machine.phase is Phase.TAKE_OFF


def test_the_time_limit_of_a_take_off_begins_after_a_long_way():
    world = World()
    world.run(Goal(takeoff_height=1.2, search_timeout=6.0, search_position=np.array([30.0, 0.0, 1.2])))
    assert world.machine.settings.transit_speed * world.machine.settings.phase_timeout < 30.0
    assert world.outcome.result is Result.PERCHED


def test_a_search_by_a_vehicle_that_does_not_come_to_rest_ends():
    world = reached(Phase.SEARCHING)
    world.machine._moves.slow = lambda state: False
    began = world.time
    while world.outcome is None and world.time < began + 60.0:
        world.tick()
    assert world.outcome.result is Result.TIMEOUT and "search hover not reached within" in world.outcome.message
    assert world.commands[-1] is Command.LAND and world.time - began < world.machine.settings.phase_timeout + 1.0


def test_a_cancel_at_the_take_off_holds_whether_or_not_it_has_begun():
    world = reached(Phase.ARMING)
    world.tick()
    assert world.controller is ControllerState.ARMED
    world.tick(cancel=True)
    assert world.commands[-2:] == [Command.LAND, Command.DISARM]


@pytest.mark.parametrize("phase", [Phase.TRACKING, Phase.VERIFYING])
@pytest.mark.parametrize("state", [ControllerState.LANDING, ControllerState.DISARMED])
def test_a_landing_that_somebody_orders_on_the_perch_is_not_undone(phase, state):
    world = reached(phase)
    world.controller = state
    world.tick()
    assert world.outcome.result is Result.TRACKING_LOST and "descends" in world.outcome.message
    assert world.commands == [Command.ARM]


def test_a_cancel_does_not_undo_a_landing():
    world = reached(Phase.TRACKING)
    world.controller = ControllerState.LANDING
    world.tick(cancel=True)
    world.tick()
    assert world.outcome.result is Result.CANCELLED and Command.HOVER not in world.commands


@pytest.mark.parametrize("phase", [Phase.TRACKING, Phase.VERIFYING])
def test_a_perch_that_was_given_up_before_the_contact_is_not_flown_again(phase):
    world = reached(phase, attempts=2)
    world.recover()
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.MISSED and "given up" in world.outcome.message and world.queries == 1


@pytest.mark.parametrize("state", [ControllerState.RECOVERING, ControllerState.HOVERING])
def test_no_new_plan_undoes_an_abort_while_one_waits_for_its_start(state):
    world = reached(Phase.TRACKING, attempts=2, replan=True)
    while len(world.flown) < 3 or world.due is None:
        world.tick()
    world.recover()
    world.controller, flown, queries = state, len(world.flown), world.queries
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.MISSED and "given up: says so" in world.outcome.message
    assert (len(world.flown), world.queries) == (flown, queries)


@pytest.mark.parametrize("replan", [False, True])
def test_no_new_plan_undoes_an_abort_before_the_first_plan_begins(replan):
    world = reached(Phase.TRACKING, attempts=2, replan=replan)
    assert world.due is not None
    world.controller, world.due, flown = ControllerState.HOVERING, None, len(world.flown)  # it drops the plan and stays
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.REFUSED and len(world.flown) == flown


@pytest.mark.parametrize("replan", [False, True])
def test_a_plan_that_the_controller_does_not_take_ends_the_goal(replan):
    world = World(takes=False)
    world.run(Goal(takeoff_height=1.2, search_timeout=6.0, attempts=2, replan=replan))
    assert world.outcome.result is Result.REFUSED and world.outcome.message.endswith("not accepted the plan: says so")
    assert world.time < world.flown[0][0] + 0.6 and world.commands == [Command.ARM, Command.HOVER]


def test_a_perch_holds_only_with_a_controller_that_is_attached():
    world = reached(Phase.PERCHED)
    world.controller = ControllerState.FAILED
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.TRACKING_LOST and "not attached" in world.outcome.message


def test_a_landing_out_of_a_recovery_ends_the_goal_with_what_the_controller_says():
    world = World(sticks=False, recovers=False)
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is not Phase.RECOVERING:
        world.tick()
    world.controller = ControllerState.LANDING
    world.tick()
    assert world.outcome.result is Result.TRACKING_LOST and world.outcome.message.endswith("; says so")


def test_recovery_without_end_is_bounded():
    world = World(sticks=False, recovers=False)
    world.machine.start(Goal(takeoff_height=1.2, search_timeout=6.0), world.time)
    while world.machine.phase is not Phase.RECOVERING:
        world.tick()
    world.hover_at, began, limit = math.inf, world.time, world.machine.settings.phase_timeout
    while world.outcome is None:
        world.tick()
    assert world.outcome.result is Result.TRACKING_LOST and f"no hover within {limit:g} s (says so)" in world.outcome.message
    assert world.commands[-1] is Command.LAND and limit < world.time - began < limit + 0.1


def test_adhesion_needs_place_attitude_speed_and_force():
    target = Target(0.0, SURFACE.p_WS, Q_PERCH, 0.01, 0.01)
    monitor = AdhesionMonitor()
    g_B = so3.quat_rotate(so3.quat_conjugate(Q_PERCH), [0, 0, GRAVITY])
    at_rest = State(SURFACE.p_WS, Q_PERCH, np.zeros(3), np.zeros(3))
    monitor.add(np.tile(g_B, (29, 1)))
    assert not monitor.attached(at_rest, target)  # the window is not full
    monitor.add(g_B)
    assert monitor.attached(at_rest, target)
    assert not monitor.attached(State(SURFACE.p_WS + [0, 0, 0.4], Q_PERCH, np.zeros(3), np.zeros(3)), target)
    assert not monitor.attached(State(SURFACE.p_WS, np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3)), target)
    assert not monitor.attached(State(SURFACE.p_WS, Q_PERCH, np.array([0, 0, -0.8]), np.zeros(3)), target)
    monitor.add(np.tile([0.0, 0.0, 3.3], (30, 1)))  # thrust alone: falling along the wall
    assert not monitor.attached(at_rest, target)
    monitor.add(np.zeros((30, 3)))
    assert monitor.detached(State(SURFACE.p_WS, Q_PERCH, np.array([0, 0, -0.6]), np.zeros(3)))
    assert not monitor.detached(at_rest)  # rocking in what holds it: no force for a moment, and no speed gathered
    monitor.add(np.tile(g_B, (30, 1)))
    assert not monitor.detached(State(SURFACE.p_WS, Q_PERCH, np.array([0, 0, -0.6]), np.zeros(3)))


@pytest.mark.parametrize("seen, home", [(True, [0.1, -0.2, 0.0]), (False, [0.1, -0.2, -1.2])])
def test_goals_in_the_air_go_by_where_the_vehicle_took_off_and_not_by_where_it_is(seen, home):
    """Nobody saw the take-off: by where it hovered at the first goal."""
    moves, goal = Moves(MissionSettings()), Goal(takeoff_height=1.2, search_timeout=6.0)
    for p in ([0.1, -0.2, 0.0], [1.0, 0.5, 2.0], [-3.0, 4.0, 3.0]):
        moves.begin(goal, State(np.array(p), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3)), on_ground=seen and p[2] == 0.0)
        assert moves.hover[0] == pytest.approx(p) and moves.home[0] == pytest.approx(home)
        assert moves.search[0] == pytest.approx(np.add(home, [0.0, 0.0, 1.2]))


def test_a_vehicle_at_rest_has_neither_moved_far_nor_fast():
    """A pad may move: 0.3 m/s for the 0.6 s of rest."""
    def at(z, v):
        return State(SURFACE.p_WS + [0.0, 0.0, z], Q_PERCH, np.array([0.0, 0.0, v]), np.zeros(3))

    assert AdhesionMonitor.rests(at(-0.18, -0.3), SURFACE.p_WS)
    assert not AdhesionMonitor.rests(at(-0.27, -0.1), SURFACE.p_WS) and not AdhesionMonitor.rests(at(-0.1, -0.6), SURFACE.p_WS)


def slid(speed: float, acceleration: float) -> tuple[list[Command], float]:
    """A perch that slides down, with the motors off: the commands since then, and how far it slid when they were given [m]."""
    world = reached(Phase.PERCHED)
    began, commands, z = world.time, [], 0.0
    force = so3.quat_rotate(so3.quat_conjugate(Q_PERCH), [0.0, 0.0, GRAVITY - acceleration])
    while not commands and world.machine.phase is Phase.PERCHED:
        t = world.time - began
        z, v = speed * t + 0.5 * acceleration * t**2, speed + acceleration * t
        out = world.machine.tick(Inputs(
            world.time, State(SURFACE.p_WS - [0.0, 0.0, z], Q_PERCH, np.array([0.0, 0.0, -v]), np.zeros(3)), True, ControllerState.ATTACHED, "",
            world.trajectory_id, None, np.tile(force, (10, 1))))
        commands, world.time = [command for command, _ in out.commands], world.time + TICK
    assert out.outcome is None or out.outcome.result is Result.PERCHED
    return commands, z


@pytest.mark.parametrize("speed, acceleration, limit", [(0.45, 0.0, 0.3), (0.0, 1.0, 0.25), (0.0, 5.0, 0.15), (0.0, 5.8, 0.15)])
def test_a_vehicle_that_slides_has_come_off(speed, acceleration, limit):
    commands, z = slid(speed, acceleration)
    assert commands == [Command.ARM, Command.HOVER] and z < limit


def test_a_vehicle_on_a_pad_that_moves_stays():
    assert slid(0.3, 0.0)[0] == []


def test_attached_is_not_repeated_once_the_vehicle_has_left():
    """The first command was lost, and the controller recovers from a miss."""
    world = reached(Phase.VERIFYING)
    world.lost_attached = 1
    while world.machine.phase is not Phase.PERCHED:
        world.tick()
    world.recover()
    world.q, world.p, world.reference = np.array([0.0, 0.0, 0.0, 1.0]), SURFACE.p_WS - [0.3, 0.0, 0.2], None
    while world.outcome is None:
        world.tick()
    assert world.commands == [Command.ARM, Command.ATTACHED] and "not attached" in world.outcome.message


def test_a_plan_that_is_sent_after_refused_ones_is_awaited_until_its_own_start():
    mission, outputs = SurfaceMission(MissionSettings()), Outputs()
    mission._others = {}

    def plan(start):
        return mission.running(Plan(rest_to_rest(np.zeros(3), np.ones(3), 0.0, 0.0, 3.0, start), 3.0), Target(0.0, np.ones(3), Q_PERCH, 0.01, 0.01))

    def starts_believed(time, trajectory_id):
        state = State(np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3))
        mission._return_to_flown_plan(Inputs(time, state, True, ControllerState.TRACKING, "", trajectory_id, None, np.zeros((0, 3))))
        return mission._running.plan.start_time

    mission._fly(plan(1.0), outputs)
    flown = mission._flown_id
    for start in (2.0, 2.05):
        mission._fly_new_plan(plan(start), outputs)
    assert [starts_believed(time, flown) for time in (2.09, 2.11)] == [2.05, 1.0]
    mission._fly_new_plan(plan(2.3), outputs)
    assert [starts_believed(time, flown) for time in (2.2, 2.39, 2.41)] == [2.3, 2.3, 1.0]
    assert starts_believed(2.42, flown + 3) == 2.3, "accepted after all"
