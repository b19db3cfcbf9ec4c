"""Two vehicles in two namespaces of one ROS domain fly at once, each as if it were alone."""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from perch_eval import modelled_sight_node
from perch_eval.domain import reserved_domain
from perch_eval.in_process import fly
from perch_eval.mcap_log import read
from perch_eval.nodes import ALL_NODES, node_programs
from perch_eval.ros.mission_client import FlightResult, MissionClient
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.stack import Stack
from perch_sim.scenario import load_scenario
from system.scripts import PATIENCE

SCENARIO, LINGER = "surface_90", 0.5
SEEDS = {"/quad1": 1, "/quad2": 2}
OF_THE_DOMAIN = {"/diagnostics", "/parameter_events", "/rosout"}


@contextmanager
def vehicle(namespace: str, folder: Path) -> Iterator[tuple[Stack, MissionClient]]:
    """The nodes of a flight without images and with a recorder, in lockstep, and who sends the goal."""
    folder.mkdir()
    overrides = {"mission": {"lockstep_hold": "perch"}, "recorder": {"file": str(folder / "flight.mcap")}}
    launches = modelled_sight_node.imageless_launches(load_scenario(SCENARIO), SEEDS[namespace], SCENARIO, True, extra=("recorder",), overrides=overrides)
    programs = node_programs(launches, folder, namespace=namespace, composed=set(ALL_NODES) - set(modelled_sight_node.NODES))
    with Stack(modelled_sight_node.imageless_programs(programs), folder) as stack:
        pilot = MissionClient(namespace)
        try:
            yield stack, pilot
        finally:
            pilot.close()


def flown(stack: Stack, pilot: MissionClient) -> FlightResult:
    """From the goal to its end."""
    result = pilot.fly(load_scenario(SCENARIO), check=stack.raise_if_ended, stall_timeout=PATIENCE)
    pilot.linger(LINGER, stack.raise_if_ended, PATIENCE)
    return result


@pytest.fixture(scope="module")
def flights(tmp_path_factory) -> tuple[dict[str, FlightResult], set[str], Path]:
    """Result of each vehicle, the topics that were there meanwhile, and the folder of the recordings."""
    folder = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch, reserved_domain() as domain, ExitStack() as running:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        both = {namespace: running.enter_context(vehicle(namespace, folder / namespace.strip("/"))) for namespace in SEEDS}
        for stack, pilot in both.values():
            stack.wait_until_ready(pilot.visible_nodes, PATIENCE)
        with ThreadPoolExecutor(len(both)) as threads:
            results = {namespace: threads.submit(flown, *one) for namespace, one in both.items()}
        topics = {name for name, _ in both["/quad1"][1].node.get_topic_names_and_types()}
    return {namespace: result.result() for namespace, result in results.items()}, topics, folder


@pytest.mark.parametrize("namespace", SEEDS)
def test_each_flight_is_the_one_that_it_is_alone(namespace, flights):
    results, _, folder = flights
    alone = fly(load_scenario(SCENARIO), SEEDS[namespace], linger=LINGER)
    recorded = RecordedFlight(folder / namespace.strip("/") / "flight.mcap", namespace)
    assert results[namespace].outcome == alone.outcome == "perched", results[namespace].message
    assert recorded.digest(alone.end_time) == alone.flight.digest(alone.end_time)


@pytest.mark.parametrize("namespace", SEEDS)
def test_time_and_frames_are_of_each_vehicle(namespace, flights):
    """Nothing is shared but what ROS has once in a domain: neither time, nor transforms, whose frames have the same names."""
    results, topics, folder = flights
    assert {topic for topic in topics if not re.match("/quad[12]/", topic)} <= OF_THE_DOMAIN
    assert results[namespace].end_time > 0.0, "the clock of the namespace"
    recorded = {topic for topic, *_ in read(folder / namespace.strip("/") / "flight.mcap")}
    assert recorded >= {f"{namespace}/tf", f"{namespace}/tf_static", f"{namespace}/odometry"}
    assert {topic for topic in recorded if not topic.startswith(f"{namespace}/")} <= OF_THE_DOMAIN
