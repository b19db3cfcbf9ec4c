"""Inspection [P:VI-A]: waypoint lines, the choice of lines, layouts, the mission's phase, and one layout flown."""

import dataclasses
import math

import numpy as np
import pytest

from perch_control.mission import ControllerState, Goal, InspectionMission, Inputs, MissionSettings, Phase, Result, State, Target
from perch_control.mission.waypoints import waypoint_lines
from perch_control.nmpc import LineWeights, chosen_lines
from perch_core import config, so3
from perch_core.errors import ConfigError, PerchError
from perch_core.lines import Segment
from perch_core.vehicle import load_vehicle
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.inspection.flight import fly, heading_along
from perch_eval.inspection.figures import metrics_figure, paths_figure
from perch_eval.inspection.layout import random_layout
from perch_eval.inspection.measures import clearance, collisions, inspection_result, judge, reference_of, reference_states, segments, watched
from perch_control.mission.parameters import MissionParameters
from perch_control.parameters import ControllerParameters
from perch_sim.scenario import Scenario, Start, Waypoint, load_scenario

BASE = load_scenario("inspection")
RADII = load_vehicle("rpg").body_radii


def test_waypoint_lines_are_straight_at_rest_at_each_and_turn_the_shorter_way():
    places = [(np.array([0.0, 0.0, 1.0]), 3.0), (np.array([1.0, 2.0, 1.5]), -3.0), (np.array([1.0, 2.1, 1.5]), 0.5)]
    lines = waypoint_lines(places, 0.5, start_time=7.0)
    assert lines.start_time == 7.0 and lines.durations[0] == pytest.approx(np.sqrt(5.25) / 0.5)
    ends = np.cumsum(lines.durations)
    for time, (p, yaw) in zip([0.0, *ends], places):
        sample = lines.sample(time)
        np.testing.assert_allclose(sample.p, p, atol=1e-9)
        np.testing.assert_allclose(np.concatenate([sample.v, sample.a]), 0.0, atol=1e-9)
        assert math.remainder(sample.yaw - yaw, 2 * math.pi) == pytest.approx(0.0, abs=1e-9)
    middle = lines.sample(0.3 * ends[0])
    assert np.linalg.norm(np.cross(middle.p - places[0][0], places[1][0] - places[0][0])) < 1e-9
    assert abs(lines.sample(ends[0]).yaw - 3.0) < 0.3  # from 3 to -3 rad by +0.28, not by -6


def test_the_watched_line_comes_first_whatever_is_nearer():
    lines = [Segment.between((x, -2.0, 2.0), (x, 2.0, 2.0), 0.03, k) for k, x in enumerate((1.0, 2.0, 3.0, 4.0))]
    p = np.array([0.0, 0.0, 2.0])
    assert [line[0] for line in chosen_lines(lines, p, ())] == [1.0, 2.0, 3.0]
    assert [line[0] for line in chosen_lines(lines, p, (4.1, 1.0, 2.2))] == [4.0, 1.0, 2.0]
    assert chosen_lines([], p, ()) == ()
    with pytest.raises(ConfigError, match="watched.*has 2 entries"):
        LineWeights(watched=(1.0, 2.0))


@pytest.mark.parametrize("seed", [1, 2, 3, 4])
def test_layouts_repeat_and_their_reference_collides_twice_and_looks_past_the_line(seed):
    layout = random_layout(BASE, seed)
    assert layout == random_layout(BASE, seed)
    assert layout.world.cables != random_layout(BASE, seed + 10).world.cables
    states, lines = reference_states(layout)[1], segments(layout)
    assert collisions(clearance(states, lines, RADII)) == 2
    assert judge(states, lines, watched(layout, lines), load_vehicle("rpg")).reprojection > 60.0
    assert collisions(clearance(states[[0, -1]], lines, RADII)) == 0


@pytest.mark.parametrize("seed", [5, 8, 11])
def test_a_turn_along_the_waypoints_at_the_first_one_shows_the_cables_that_cross_them(seed):
    layout, mount = random_layout(BASE, seed), load_vehicle("rpg").mounts["front"]

    def seen(yaw):
        p_WC, R_WC = mount.pose(np.array(layout.inspection.waypoints[0].position), so3.exp(np.array([0.0, 0.0, yaw])))
        views = (mount.camera.project((np.linspace(*cable.ends, 41) - p_WC) @ R_WC) for cable in segments(layout))
        return {k for k, (pixels, valid) in enumerate(views) if np.any(valid & mount.camera.contains(pixels))}

    at_first = math.radians(layout.inspection.waypoints[0].yaw_deg)
    assert len(seen(at_first)) < 3 and set().union(*map(seen, np.linspace(at_first, heading_along(layout), 9))) == {0, 1, 2}


def test_collisions_are_counted_by_their_beginnings():
    states = np.tile([0.0, 0, 0, 0, 0, 0, 1.0], (5, 1))
    states[:, 0] = [0.0, 1.0, 0.0, 0.1, 1.0]
    assert collisions(clearance(states, [Segment.between((0.0, -1, 0), (0.0, 1, 0), 0.03)], RADII)) == 2


def test_a_scenario_says_what_its_nodes_fly():
    params = NodeParameters(BASE, 1)
    places = params.node_config("mission", MissionParameters).mission.places
    assert [tuple(p) for p, _ in places] == [w.position for w in BASE.inspection.waypoints]
    assert places[0][1] == pytest.approx(math.radians(BASE.inspection.waypoints[0].yaw_deg))
    assert params.node_config("controller", ControllerParameters).nmpc.lines.watched == BASE.inspection.watched
    with pytest.raises(ConfigError, match="waypoints.*needs at least 2"):
        config.from_mapping(Scenario, {"name": "x", "mode": "inspection"}, "x.yaml")
    with pytest.raises(ConfigError, match=r"waypoints\[1\].position: \(1, 0, 9\) m is outside the room"):
        config.from_mapping(Scenario, {"name": "x", "mode": "inspection", "inspection": {
            "waypoints": [{"position": [1.0, 0.0, 1.0]}, {"position": [1.0, 0.0, 9.0]}]}}, "x.yaml")
    with pytest.raises(ConfigError, match="waypoints.*5 entries"):
        MissionSettings(waypoints=(1.0,) * 5)
    with pytest.raises(PerchError, match="not inspection"):
        fly(dataclasses.replace(BASE, mode="powerline"), 1)


@pytest.mark.parametrize("ends, off, result, message", [
    (True, 0.0, Result.PERCHED, "inspected along 2 waypoints"), (False, 0.0, Result.MISSED, "inspection given up: held up"),
    (False, 0.0, Result.REFUSED, "the controller has not accepted the inspection: held up"),
    pytest.param(True, 0.6, Result.PERCHED, "inspected along 2 waypoints", id="the line terms hold it away from its place")])
def test_the_mission_maps_then_flies_the_waypoints_and_ends_in_a_hover(ends, off, result, message):
    settings = MissionSettings(waypoints=(1.0, 0.0, 2.0, 0.0, 1.0, 2.0, 2.5, 10.0))
    machine, controller, id, reference, seen, outcome = InspectionMission(settings), ControllerState.DISARMED, 0, None, [], None
    machine.start(Goal(1.2, 10.0, perch_point=np.array([3.0, 0.0, 2.0])), 0.0)
    p, time = np.zeros(3), 0.0
    while outcome is None and time < 60.0:
        time += 0.02
        if reference is not None:
            p = reference.sample(time - reference.start_time).p
            share = (time - reference.start_time) / reference.duration
            if share >= 1.0 or (machine.phase is Phase.INSPECTING and not ends and share > 0.5):
                controller = ControllerState.HOVERING
        target = Target(time, np.array([3.0, 0.0, 2.0]), np.array([0, 0, 0, 1.0]), 0.01, 0.01) if time > 6.0 else None
        out = machine.tick(Inputs(time, State(p + [off, 0.0, 0.0], np.array([0, 0, 0, 1.0]), np.zeros(3), np.zeros(3)), True, controller, "held up", id,
                                  target, np.zeros((0, 3))))
        if any(command.name == "ARM" for command, _ in out.commands):
            controller = ControllerState.ARMED
        if out.reference is not None and (result is not Result.REFUSED or machine.phase is not Phase.INSPECTING):
            reference, controller, id = out.reference, ControllerState.TRACKING, out.trajectory_id
        assert out.query is None, "an inspection needs no planner"
        seen.append(machine.phase)
        outcome = out.outcome
    assert outcome.result is result and message in outcome.message
    assert result is not Result.REFUSED or seen.count(Phase.INSPECTING) * 0.02 < 1.0
    assert Phase.SEARCHING in seen and Phase.INSPECTING in seen
    if ends:
        np.testing.assert_allclose(p, (1.0, 2.0, 2.5), atol=1e-6)


def test_a_way_that_is_the_reference_is_judged_as_the_reference_and_drawn(tmp_path):
    times, states = reference_states(BASE)
    found = inspection_result(BASE, times, states)
    assert found.collisions == found.reference.collisions == 2 and found.flown.reprojection == found.reference.reprojection
    assert inspection_result(BASE, times[:100], states[:100], crashes=1).collisions == 1
    away = states.copy()
    away[:, 0] -= 2.0
    assert inspection_result(BASE, times, away).collisions == 0
    for name, figure in (("paths", paths_figure(found)), ("metrics", metrics_figure(found))):
        figure.savefig(tmp_path / f"{name}.png")
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000


def into_the_cable(*back):
    """One waypoint in the cable, and others after it, flown briskly: twelve seconds of flight instead of thirty."""
    waypoints = tuple(Waypoint(position=p) for p in ((2.4, -0.6, 2.2), (3.95, 0.0, 2.7), *back))
    return dataclasses.replace(BASE, start=Start(position=(2.4, -0.6, 0.0)),
                               inspection=dataclasses.replace(BASE.inspection, waypoints=waypoints, speed=1.0))


def test_the_line_terms_avoid_the_collision_and_keep_the_line_centred():
    scenario = into_the_cable((2.4, 0.6, 2.2))
    flight = fly(scenario, 1)
    assert not flight.message and flight.collisions == 0 and flight.reference.collisions == 1
    assert flight.reference.reprojection > 5.0 * flight.flown.reprojection
    assert flight.flown.visibility.cheirality.all() and flight.mapped == 3
    assert flight.times[-1] == pytest.approx(reference_of(scenario).duration, abs=0.05)


def test_without_the_line_terms_the_reference_is_followed_into_the_cable():
    flight = fly(into_the_cable(), 1, with_lines=False)
    assert flight.collisions == 1 and "a cable in the rotors" in flight.message
