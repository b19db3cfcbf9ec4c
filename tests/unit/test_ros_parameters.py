"""Parameters of nodes as `ros2 param` sees them: over the services that every node offers."""

from __future__ import annotations

import time
from dataclasses import dataclass
from types import SimpleNamespace

import pytest
import rclpy
from perch_core.component import Component
from perch_core.config import choice, derived, quantity, text
from perch_core.errors import ConfigError, PerchError
from perch_core.registry import resolved
from perch_core.ros.node import NodeSpec, _warn_unused_parameter_files, spin_until_stopped
from perch_core.ros.parameters import _leaves
from perch_eval.in_process.parameters import COMPONENTS
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient

PATIENCE = 120.0  # only ever waited for in full when a test fails [s]
DOUBLE, INTEGER, STRING, DOUBLES = (Parameter.Type[name].value for name in ("DOUBLE", "INTEGER", "STRING", "DOUBLE_ARRAY"))


@dataclass(frozen=True)
class Config:
    gain: float = quantity(2.0, unit="1/s", above=0.0, high=10.0, doc="of position")
    count: int = quantity(3, low=1, high=9, doc="tries")
    law: str = choice("slow", options=("slow", "fast"), doc="which")
    weights: tuple[float, ...] = quantity((1.0, 2.0), unit="kg", low=0.0, high=5.0, doc="of the parts")
    vehicle: str = text("rpg", doc="whose")
    told: float = derived(0.5)


class Tuned(Component[Config]):
    config_type = Config
    changeable = ("gain", "count", "law", "weights")

    def reconfigure(self, config):
        if config.gain == 7.0:
            raise ConfigError("", "gain", "7 shakes the frame")
        if config.gain == 8.0:
            raise PerchError("no law can be built for 8")
        super().reconfigure(config)
        if config.gain == 9.0:
            raise ZeroDivisionError("a defect, after a part has changed")


class Graph:
    """The node and a client of its parameters."""

    def __init__(self):
        self.context = Context()
        rclpy.init(args=[], context=self.context)
        self.tuned = NodeSpec("tuned", Tuned).create(context=self.context, use_global_arguments=False)
        self.asker = Node("asker", context=self.context)
        self.executor = SingleThreadedExecutor(context=self.context)
        self.executor.add_node(self.tuned), self.executor.add_node(self.asker)
        self.client = AsyncParameterClient(self.asker, "tuned")
        end = time.monotonic() + PATIENCE
        while not self.client.services_are_ready():
            assert time.monotonic() < end
            self.executor.spin_once(timeout_sec=0.05)

    def answer(self, future):
        self.executor.spin_until_future_complete(future, PATIENCE)
        assert future.done()
        return future.result()

    def describe(self, name):
        return self.answer(self.client.describe_parameters([name])).descriptors[0]

    def get(self, name):
        return self.tuned.get_parameter(name).value

    def set(self, name, value):
        return self.answer(self.client.set_parameters([Parameter(name, value=value)])).results[0]

    def close(self):
        self.tuned.close()
        self.context.try_shutdown()


@pytest.fixture
def graph(ros_domain):
    one = Graph()
    yield one
    one.close()


def test_types_ranges_units_and_what_is_fixed_are_described(graph):
    gain, count, law, weights, vehicle = map(graph.describe, ("gain", "count", "law", "weights", "vehicle"))
    assert [d.type for d in (gain, count, law, weights, vehicle)] == [DOUBLE, INTEGER, STRING, DOUBLES, STRING]
    assert (gain.description, gain.floating_point_range[0].to_value) == ("of position", 10.0)
    assert 0.0 < gain.floating_point_range[0].from_value < 1e-300 and "[1/s]" in gain.additional_constraints
    assert (count.integer_range[0].from_value, count.integer_range[0].to_value) == (1, 9)
    assert "one of slow, fast" in law.additional_constraints and "[kg]" in weights.additional_constraints
    assert [d.read_only for d in (gain, count, law, weights, vehicle)] == [False] * 4 + [True]
    assert not any(d.dynamic_typing for d in (gain, count, law, weights, vehicle)) and not graph.tuned.has_parameter("told")


@pytest.mark.parametrize("name, value, words", [
    ("gain", 11.0, "gain: 11 is outside (0, 10] 1/s"), ("gain", 0.0, "gain: 0 is outside (0, 10] 1/s"), ("gain", 7.0, "gain: 7 shakes the frame"),
    ("gain", "much", "gain: 'much' is not of type float"), ("gain", 8.0, "no law can be built"), ("gain", 9.0, "ZeroDivisionError: a defect"),
    ("gain", float("nan"), "gain: nan is outside (0, 10] 1/s"), ("count", 10, "count: 10 is outside [1, 9]"),
    ("count", 2.5, "count: 2.5 is not of type int"), ("law", "middling", "law: 'middling' is not one of slow, fast"),
    ("weights", [1.0, -1.0], "weights: -1 is outside [0, 5] kg"), ("weights", ["heavy"], "weights[0]: 'heavy' is not of type float"),
    ("vehicle", "snapdragon", "read-only parameter: vehicle"), ("no_such_gain", 1.0, "no_such_gain: unknown parameter; allowed: gain, count")])
def test_a_refused_value_changes_nothing_and_says_why(graph, name, value, words):
    known = name != "no_such_gain"
    before = (graph.describe(name), graph.get(name)) if known else None
    result = graph.set(name, value)
    assert not result.successful and words in result.reason, result
    if known:
        assert (graph.describe(name), graph.get(name)) == before
        assert graph.tuned.component.config == Config()


def test_a_change_that_raises_counts_as_a_failure_and_one_that_is_refused_does_not(graph):
    graph.set("gain", 8.0)
    assert graph.tuned._failures == 0
    graph.set("gain", 9.0)
    assert graph.tuned._failures == 1 and graph.set("gain", 5.0).successful


def test_a_parameter_of_an_unknown_type_does_not_end_the_node(graph):
    client = graph.asker.create_client(SetParameters, "tuned/set_parameters")
    unknown = Parameter("gain", value=3.0).to_parameter_msg()
    unknown.value = ParameterValue(type=99)
    assert graph.answer(client.call_async(SetParameters.Request(parameters=[unknown]))).results == []
    assert graph.tuned._failures == 1 and graph.set("gain", 4.5).successful and graph.get("gain") == 4.5


def test_an_exception_that_leaves_a_callback_does_not_end_the_node(graph, monkeypatch):
    executor, ticks = EventsExecutor(context=graph.context), []
    graph.executor.remove_node(graph.tuned), executor.add_node(graph.tuned)

    def tick():
        ticks.append(1)
        if len(ticks) == 2:
            raise ZeroDivisionError("a defect")

    class Stop:
        end = time.monotonic() + PATIENCE

        def __bool__(self):
            return len(ticks) > 3 or time.monotonic() > self.end

    graph.tuned.create_timer(0.01, tick)
    monkeypatch.setattr("rclpy.ok", lambda: True)  # of this context
    spin_until_stopped(executor, Stop(), graph.tuned.log_refusal)
    assert len(ticks) > 3 and graph.tuned._failures == 1


@pytest.mark.parametrize("name, value, got", [("gain", 4.5, 4.5), ("gain", 5, 5.0), ("weights", [3, 4], [3.0, 4.0]), ("weights", [0.5], [0.5]),
                                              ("count", 4, 4), ("law", "fast", "fast")])
def test_an_accepted_value_counts_at_once_whole_numbers_for_real_ones_too(graph, name, value, got):
    result = graph.set(name, value)
    assert result.successful, result.reason
    shown = graph.get(name)
    assert (list(shown) if isinstance(got, list) else shown) == got
    config = getattr(graph.tuned.component.config, name)
    assert (list(config) if isinstance(got, list) else config) == got


@pytest.mark.parametrize("name", ["lockstep_timout", "use_sim_timee", "start_type_description_services", "qos_overrides./odometry.subscription.depth"])
def test_names_that_begin_as_a_parameter_of_the_host_are_refused(graph, name):
    with pytest.raises(ConfigError, match=name):
        NodeSpec("mistyped", Tuned).create(context=graph.context, use_global_arguments=False, parameter_overrides=[Parameter(name, value=True)])


@pytest.mark.parametrize("section, used", [
    ("tuned", True), ("/tuned", True), ("/**", True), ("/*", True), ("/**/tuned", True), ("tunde", False), ("/a/tuned", False), ("a: {tuned", False)])
def test_a_parameter_file_without_a_section_for_the_node_is_warned_of(tmp_path, monkeypatch, graph, section, used):
    file, warned = tmp_path / "tuned.yaml", []
    file.write_text(f"{section}: {{ros__parameters: {{count: 5}}}}{'}' * section.count('{')}")
    monkeypatch.setattr(graph.tuned, "get_logger", lambda: SimpleNamespace(warning=warned.append))
    arguments = ["--ros-args", "--params-file", str(file)]
    _warn_unused_parameter_files(arguments, [graph.tuned])
    assert warned == [f"{file}: not used: its sections are /{section.strip('/').replace(': {', '/')}, none of which is /tuned"] * (not used)
    other = Node("tuned", context=graph.context, cli_args=arguments, use_global_arguments=False)
    assert ("count" in other._parameter_overrides) is used
    other.destroy_node()


AUTOPILOTS = {"betaflight": "perch_autopilot.betaflight:Betaflight", "mavlink": "perch_autopilot.mavlink:Mavlink"}


def test_parameters_are_those_that_a_user_has_a_reason_to_set():
    """Of the vehicle, its sensors, the site, the processor, safety; what belongs to an algorithm is a constant beside its equation."""
    assert sum(len(_leaves(resolved(component).config_type)) for component in (COMPONENTS | AUTOPILOTS).values()) <= 150
