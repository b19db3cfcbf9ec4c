"""Two vehicles in two namespaces of one ROS domain fly at once, each as if it were alone and without ROS, to the last bit.

One perches on a wall, the other on a cable. No images are rendered, which would take two minutes of processor time for the cable: its
map is made from the truth, and stays as it is. That engines agree on images is shown in `test_flight_surface.py`. The nodes are forked.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from closed_loop.perched import SEEDS, Perched, perched
from perch_eval import modelled_sight_node
from perch_eval.domain import reserved_domain
from perch_eval.goal import outcome_of
from perch_eval.mcap_log import read
from perch_eval.nodes import ALL_NODES, node_programs
from perch_eval.ros.mission_client import FlightResult, MissionClient
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_eval.stack import Stack
from perch_sim.contact_event import ContactState
from perch_sim.scenario import load_scenario
from system import forks
from system.scripts import PATIENCE

LINGER = 0.5
SCENARIOS = {"/quad1": "surface_90", "/quad2": "line_80"}
OF_THE_DOMAIN = {"/diagnostics", "/parameter_events", "/rosout"}


@contextmanager
def vehicle(namespace: str, folder: Path) -> Iterator[tuple[Stack, MissionClient]]:
    """The nodes of a flight without images and with a recorder, in lockstep, and who sends the goal."""
    folder.mkdir()
    overrides = {"mission": {"lockstep_hold": "perch"}, "recorder": {"file": str(folder / "flight.mcap")}}
    name = SCENARIOS[namespace]
    launches = modelled_sight_node.imageless_launches(load_scenario(name), SEEDS[name], name, True, extra=("recorder",), overrides=overrides)
    programs = node_programs(launches, folder, namespace=namespace, composed=set(ALL_NODES) - set(modelled_sight_node.NODES))
    with Stack(modelled_sight_node.imageless_programs(programs), folder) as stack:
        pilot = MissionClient(namespace)
        try:
            yield stack, pilot
        finally:
            pilot.close()


def flown(namespace: str, stack: Stack, pilot: MissionClient) -> tuple[FlightResult, set[str]]:
    """From the goal to its end, and the topics that are there then; nothing flies on while the other one does."""
    result = pilot.fly(load_scenario(SCENARIOS[namespace]), check=stack.raise_if_ended, stall_timeout=PATIENCE)
    pilot.linger(LINGER, stack.raise_if_ended, PATIENCE)
    topics = {name for name, _ in pilot.node.get_topic_names_and_types()}
    stack.stop()
    return result, topics


@pytest.fixture(scope="module")
def flights(tmp_path_factory) -> tuple[dict[str, FlightResult], set[str], Path]:
    """Result of each vehicle, the topics that were there when the first had flown, and the folder of the recordings."""
    folder = tmp_path_factory.mktemp("two")
    with pytest.MonkeyPatch.context() as patch, reserved_domain() as domain, ExitStack() as running:
        patch.setenv("ROS_DOMAIN_ID", str(domain))
        forks.fork_programs(patch)
        both = {namespace: running.enter_context(vehicle(namespace, folder / namespace.strip("/"))) for namespace in SCENARIOS}
        for stack, pilot in both.values():
            stack.wait_until_ready(pilot.visible_nodes, PATIENCE)
        with ThreadPoolExecutor(len(both)) as threads:
            results = {namespace: threads.submit(flown, namespace, *one) for namespace, one in both.items()}
    return {namespace: result.result()[0] for namespace, result in results.items()}, results["/quad1"].result()[1], folder


@pytest.fixture(scope="module")
def alone() -> dict[str, Perched]:
    """The same flights without ROS."""
    return {namespace: perched(name) for namespace, name in SCENARIOS.items()}


@pytest.mark.parametrize("namespace", SCENARIOS)
def test_each_flight_is_the_one_that_it_is_alone(namespace, flights, alone):
    results, _, folder = flights
    result, other = results[namespace], alone[namespace]
    recorded = RecordedFlight(folder / namespace.strip("/") / "flight.mcap", namespace)
    assert result.outcome == outcome_of(other.result.error_code, load_scenario(SCENARIOS[namespace])) == "perched", result.message
    assert result.message == other.result.message
    assert recorded.digest(other.time) == other.digest


def test_the_wire_is_gripped_on_a_plan_with_recovery_and_no_other_line_is_touched(flights, alone):
    _, _, folder = flights
    recorded, other = RecordedFlight(folder / "quad2" / "flight.mcap", "/quad2"), alone["/quad2"]
    plans = [order.id for order in other.plans if order.recovery_start > 0.0]
    assert plans and [order.id for _, order in recorded.values("trajectory") if order.recovery_start > 0.0] == plans
    touched = [c for c in other.contacts if c.body.startswith("cable")]
    assert [(ContactState(c.state).name, c.body) for c in touched] == [("ATTACHED", "cable 0")], "that of the perch point"


@pytest.mark.parametrize("namespace", SCENARIOS)
def test_time_and_frames_are_of_each_vehicle(namespace, flights):
    """Nothing is shared but what ROS has once in a domain: neither time, nor transforms, whose frames have the same names."""
    results, topics, folder = flights
    assert {topic for topic in topics if not re.match("/quad[12]/", topic)} <= OF_THE_DOMAIN
    assert results[namespace].end_time > 0.0, "the clock of the namespace"
    recorded = {topic for topic, *_ in read(folder / namespace.strip("/") / "flight.mcap")}
    assert recorded >= {f"{namespace}/tf", f"{namespace}/tf_static", f"{namespace}/odometry"}
    assert {topic for topic in recorded if not topic.startswith(f"{namespace}/")} <= OF_THE_DOMAIN
