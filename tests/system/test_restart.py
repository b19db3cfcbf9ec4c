"""A node that is killed in flight and started again takes its place; one that hangs is named with what it owes; every flight ends safely."""

from __future__ import annotations

import signal
from dataclasses import replace

import pytest
from perch_core.errors import PerchError
from perch_msgs.msg import ControllerStatus
from system.rig import BLIND, Rig, rig

FOR_LONG = "mission: {search_timeout: 100.0}\ntime_limit: 200.0\n"  # it looks for a target until it is disturbed, however late that comes


@pytest.fixture(autouse=True)
def domain(ros_domain):
    """Each test in a ROS domain of its own."""


def killed(flight: Rig, name: str):
    """Kill a node and start it again; then it is there."""
    gone, back = flight.said(f"lockstep: {name} has disconnected"), flight.said(f"lockstep: {name} has reconnected")
    flight.kill(name)
    yield lambda: flight.said(f"lockstep: {name} has disconnected") > gone
    flight.start(name)
    yield lambda: flight.said(f"lockstep: {name} has reconnected") > back


def test_in_lockstep_they_take_their_places_hanging_ones_are_named_with_what_they_owe_and_it_perches(tmp_path):
    with rig(tmp_path, ("vio_model", "estimator", "mission", "target_localizer")) as flight:
        def acts():
            yield "take_off"
            yield from killed(flight, "vio_model")
            process = flight.pilot.processes.get("/mission")
            yield from killed(flight, "mission")
            yield lambda: flight.pilot.processes.get("/mission") != process  # the pilot has discovered it
            yield lambda: flight.controller == ControllerStatus.HOVERING
            yield from killed(flight, "estimator")

        above = replace(flight.scenario, mission=replace(flight.scenario.mission, takeoff_height=3.0), time_limit=200.0)
        lost = flight.fly(acts(), above)  # a climb that takes a while
        assert str(lost) in ("the mission was restarted: its goal was dropped", "the mission has ended: its goal was dropped"), lost

        def hangs():
            for name, owed in (("estimator", "its answer to the present step"), ("target_localizer", "its results")):
                yield "searching"
                line = f"lockstep: for .* waiting for .*{name}: {owed}"
                before = flight.said(line)
                flight.signal(name, signal.SIGSTOP)
                yield lambda: f"{name}: {owed}" in flight.pilot.waiting_for
                yield lambda: flight.said(line) > before
                flight.signal(name, signal.SIGCONT)

        result = flight.fly(hangs())
        assert getattr(result, "outcome", "") == "perched", result


def test_a_restarted_controller_leaves_the_motors_off_and_the_mission_says_so(tmp_path):
    with rig(tmp_path, ("controller",), scenario=BLIND + FOR_LONG) as flight:
        def acts():
            yield "searching"
            yield from killed(flight, "controller")

        result = flight.fly(acts())
        assert result.outcome == "tracking_lost" and "disarmed" in result.message
        flight.until(lambda: flight.on_floor() and flight.controller == ControllerStatus.DISARMED, "it is not on the floor with its motors off")


def test_a_node_that_was_dropped_as_it_hung_comes_back_and_answers_to_its_goal(tmp_path):
    with rig(tmp_path, ("mission",), scenario=BLIND.replace("lockstep_timeout: 300.0", "lockstep_timeout: 4.0")) as flight:
        def acts():
            yield "searching"
            flight.signal("mission", signal.SIGSTOP)
            yield lambda: flight.said("lockstep: mission is silent for .*: dropped") > 0
            flight.signal("mission", signal.SIGCONT)
            yield lambda: flight.said("lockstep: mission has reconnected") > 0

        result = flight.fly(acts())
        assert flight.said("lockstep: mission has reconnected") and getattr(result, "message", ""), result


def test_in_real_time_every_flight_ends_safely_and_the_next_begins(tmp_path):
    """Deadlines are not judged here: on a busy machine a goal may end otherwise, but it ends, the vehicle is at rest, and its time passes."""
    safe = (ControllerStatus.DISARMED, ControllerStatus.HOVERING, ControllerStatus.FAILED)  # the last one: motors off, and it says why
    with rig(tmp_path, ("vio_model", "estimator", "mission", "controller"), lockstep=False, scenario=BLIND + "mission: {search_timeout: 3.0}\n") as flight:
        for names in (("vio_model", "mission"), ("estimator", "controller")):
            def acts():
                yield "searching"
                for name in names:
                    flight.kill(name)
                    flight.start(name)
                    yield lambda: f"/{name}" in flight.pilot.visible_nodes()

            result = flight.fly(acts())
            assert str(result) if isinstance(result, PerchError) else result.message
            flight.listen(2.0)  # what is left of the one that was killed in the graph may take part in the next goal's discovery
            rests = flight.on_floor if "controller" in names else flight.at_rest  # its motors are off
            flight.until(lambda: rests() and flight.controller in safe, f"after {names} were killed, and {result}")
            now = flight.pilot.time
            flight.until(lambda: flight.pilot.time > now, f"the vehicle hangs after {names} were killed")
