"""Speed of the ROS graph: real-time factor of the whole stack, and whether it sustains 500 Hz in real time."""

from __future__ import annotations

import dataclasses
import os
import tempfile
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import partial
from pathlib import Path

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from harness import Figure, figure
from machine import LateWakeUps, StolenTime, cores_awake, late_with_load
from perch_core.errors import PerchError
from perch_core.ros.topics import stamp_of, topic
from perch_core.trajectory import rest_to_rest
from perch_core.values import Command, ControllerCommand, TrajectoryOrder, nanoseconds, seconds
from perch_eval.campaign.causes import SUCCESS
from perch_eval.demo import fly
from perch_eval.domain import domain_in_environment
from perch_eval.nodes import ALL_NODES, CHAIN_NODES, programs
from perch_eval.ros.graph_node import GraphNode
from perch_eval.stack import Stack
from perch_sim.scenario import Scenario, load_scenario

SEEDS = "flights: from 1, one each; the rest: 1"
CHAIN = ("vehicle", "vio_model", "estimator", "controller")  # the stand-in VIO: nothing here is about estimation
RATES = ("imu/data_raw", "odometry", "motor_command")
WINDOW = 1.0  # s


class Probe(GraphNode):
    """Node that measures a running stack."""

    def __init__(self) -> None:
        super().__init__("probe")
        self.counts = dict.fromkeys(RATES, 0)
        self.stamp = 0  # of the newest odometry [ns]
        self._orders = {channel: self.node.create_publisher(topic(channel).message, channel, topic(channel).qos.publish)
                        for channel in ("controller/command", "trajectory")}
        self.diagnostics: dict[str, dict[str, str]] = {}
        for channel in RATES:
            self.node.create_subscription(topic(channel).message, channel, partial(self._count, channel), topic(channel).qos.subscribe, raw=True)
        # read by hand: an executor does not pass on when a message was sent
        self._aside = rclpy.create_node("probe_aside", context=self._context)
        self._newest = {channel: self._aside.create_subscription(topic(channel).message, channel, print, topic(channel).qos.subscribe, raw=True)
                        for channel in ("imu/data_raw", "motor_command")}
        diagnostics = topic("/diagnostics")
        self.node.create_subscription(diagnostics.message, diagnostics.channel, self._diagnose, diagnostics.qos.subscribe)

    @property
    def time(self) -> float:
        """Stamp of the newest odometry [s]."""
        return seconds(self.stamp)

    def order(self, channel: str, value: object) -> None:
        """Publish an order to the controller."""
        self._orders[channel].publish(topic(channel).to_message(value))

    def _count(self, channel: str, data: bytes) -> None:
        self.counts[channel] += 1
        if channel == "odometry":
            self.stamp = stamp_of(topic(channel).message, data)

    def delays(self) -> list[float]:
        """Return the delays from the publication of an IMU sample to that of its motor command, of the newest samples [us]."""
        sent: dict[str, dict[int, int]] = {}
        for channel, subscription in self._newest.items():
            sent[channel] = {}
            with subscription.handle:
                while (taken := subscription.handle.take_message(subscription.msg_type, True)) is not None:
                    sent[channel][stamp_of(subscription.msg_type, taken[0])] = taken[1]["source_timestamp"]
        imu, command = sent["imu/data_raw"], sent["motor_command"]
        return [1e-3 * (command[stamp] - imu[stamp]) for stamp in imu.keys() & command.keys()]

    def _diagnose(self, msg: DiagnosticArray) -> None:
        for status in msg.status:
            self.diagnostics[status.name.rsplit("/", 1)[-1]] = {item.key: item.value for item in status.values}

    def count(self, node: str, key: str) -> int:
        """Return a count from a node's diagnostics."""
        return int(self.diagnostics.get(node, {}).get(key, 0))

    def take_off(self) -> None:
        """Wait for the estimate, arm, and fly to a hover at 1 m."""
        self.spin_until(lambda: self.diagnostics.get("estimator", {}).get("state") == "RUNNING", 10.0)
        self.spin_for(2.0)
        self.order("controller/command", ControllerCommand(self.stamp, Command.ARM, "bench"))
        self.spin_for(0.2)
        begin = self.stamp + nanoseconds(0.2)
        climb = rest_to_rest(np.zeros(3), np.array([0.0, 0.0, 1.0]), 0.0, 0.0, 2.0, start_time=seconds(begin))
        self.order("trajectory", TrajectoryOrder(1, climb))
        self.spin_for(4.0)
        if (state := self.diagnostics.get("controller", {}).get("state")) != "HOVERING":
            raise PerchError(f"the controller is {state} after the take-off, not HOVERING")

    def close(self) -> None:
        """Leave the graph."""
        self._aside.destroy_node()
        super().close()


@contextmanager
def running(scenario: Scenario, folder: Path, **options) -> Iterator[tuple[Probe, Stack]]:
    """Run a stack and a probe; yield both when the stack is ready and stepping."""
    with domain_in_environment(), Stack(programs(scenario, folder=folder, **options), folder) as stack, closing(Probe()) as probe:
        stack.wait_until_ready(probe.visible_nodes)
        for _ in range(600):
            if probe.time > 2.0:  # one second of flight
                break
            probe.spin_for(0.1)
            stack.raise_if_ended()
        else:
            raise PerchError(f"simulation time is {probe.time:g} s after 60 s: the nodes do not step")
        yield probe, stack


def real_time(scenario: Scenario, folder: Path, windows: int, law: str = "geometric",
              composed: tuple[str, ...] = CHAIN_NODES) -> list[Figure]:
    """Measure a hover without cameras in real time: rates of the 500 Hz chain, and missed deadlines.

    The bars are those of the layout of `demo.py --realtime`; with one process per node, only the delay has one.
    """
    where = f"real time, {law}" + ("" if composed else ", one process per node")
    overrides = {"vehicle": {"cameras": "none"}, "controller": {"controller.type": law}}
    with cores_awake(), running(scenario, folder, lockstep=False, composed=composed, overrides=overrides) as (probe, stack):
        probe.take_off()
        counts_of = (("vehicle", "deadlines_missed", "steps"), ("vehicle", "commands_missed", "steps"),
                     ("estimator", "missed_deadlines", "deadlines"), ("controller", "missed_deadlines", "deadlines"))

        def counted() -> list[tuple[int, int]]:
            return [(probe.count(node, part), probe.count(node, whole)) for node, part, whole in counts_of]

        before, delays = counted(), []
        rates, wake_ups, host, used = {channel: [] for channel in RATES}, LateWakeUps(), StolenTime(), processor_time(stack)
        for _ in range(windows):
            counts = dict(probe.counts)
            delays += probe.delays()
            span = probe.spin_for(WINDOW)
            for channel in RATES:
                rates[channel].append((probe.counts[channel] - counts[channel]) / span)
        late, stolen, used = wake_ups.share(), host.share(), processor_time(stack) - used
        after = counted()
        load = used / max(1, after[0][1] - before[0][1])
    out = [figure(f"{where}: rate of {channel}", "Hz", samples, bar=499.0 if composed else None, comparison="median >=")
           for channel, samples in rates.items()]
    for (node, part, _), (old, old_all), (new, new_all) in zip(counts_of, before, after):
        share = 100.0 * (new - old) / max(1, new_all - old_all)
        out.append(figure(f"{where}: {part.replace('_', ' ')}, {node}", "% of steps", [share],
                          bar=0.1 if composed and part != "commands_missed" else None))
    out += [figure(f"{where}: processor time of the nodes' callbacks", "us per step", [1e6 * load]),
            figure(f"{where}: bare timer beside it late by a period", "% of steps", [late]),
            figure(f"{where}: processor time that the host took away", "% of all cores", [stolen])]
    if composed:
        with cores_awake():
            same = late_with_load(load, windows * WINDOW)
        out.append(figure(f"{where}: loop of as much processor time late by a period", "% of steps", [same]))
    return [*out, figure(f"{where}: command after its IMU sample, from publication to publication", "us", delays,
                          bar=150.0 if composed else 480.0, comparison="median <=")]


def processor_time(stack: Stack) -> float:
    """Return the processor time used so far by the busiest program's main thread, which runs its nodes' callbacks [s]; Linux."""
    stats = [Path(f"/proc/{pid}/task/{pid}/stat").read_text().rpartition(")")[2].split() for pid in stack.pids.values()]
    return max(int(fields[11]) + int(fields[12]) for fields in stats) / os.sysconf("SC_CLK_TCK")


def lockstep(scenario: Scenario, folder: Path, windows: int, composed: tuple[str, ...]) -> Figure:
    """Measure the real-time factor of the 500 Hz chain in lockstep, without cameras."""
    with running(scenario, folder, composed=composed, overrides={"vehicle": {"cameras": "none"}}) as (probe, _):
        factors = [_factor(probe) for _ in range(windows)]
    where = "one process" if composed else "one process per node"
    return figure(f"lockstep without cameras, {where}", "x real time", factors)


def _factor(probe: Probe) -> float:
    begin = probe.time
    span = probe.spin_for(WINDOW)
    return (probe.time - begin) / span


def figures(quick: bool) -> list[Figure]:
    """Measure whole flights with both cameras, and the 500 Hz chain in lockstep and in real time."""
    scenario = dataclasses.replace(load_scenario("surface_90"), nodes=CHAIN)
    windows = 3 if quick else 10
    with tempfile.TemporaryDirectory(prefix="perch-bench-") as name:
        folder = Path(name)
        flights = [fly("surface_90", seed, folder / f"flight_{seed}") for seed in range(1, 2 if quick else 4)]
        factors = [flight["real_time_factor"] if flight["cause"] == SUCCESS else np.nan for flight in flights]
        return [figure("whole stack, both cameras, lockstep, flights that perch", "x real time", factors, bar=0.7, comparison="median >="),
                lockstep(scenario, folder / "processes", windows, composed=()),
                lockstep(scenario, folder / "composed", windows, composed=ALL_NODES),
                *real_time(scenario, folder / "real_time", windows),
                *real_time(scenario, folder / "real_time_nmpc", windows, "nmpc"),
                *real_time(scenario, folder / "real_time_processes", windows, composed=())]
