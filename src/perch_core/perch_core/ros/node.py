"""The base of every node and its main loop."""

from __future__ import annotations

import inspect
import os
import signal
import sys
from contextlib import ExitStack
from typing import Any, Callable, Generic, Iterator, NoReturn, Sequence, TypeVar

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")  # one core per node; must be set before numpy is imported

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future

from perch_core.errors import ConfigError
from perch_core.processes import freeze_heap
from perch_core.ros import qos
from perch_core.ros.backlog import Backlog
from perch_core.ros.composition import composition
from perch_core.ros.conversions import to_stamp
from perch_core.ros.parameters import Parameters
from perch_core.ros.priority import priority

T = TypeVar("T")
LOOK = 0.1  # [s] wall clock, between looks for a signal to stop


class PerchNode(Node, Generic[T]):
    """A node with typed parameters and diagnostics.

    Subclasses are created by their module's `create(**kwargs)`, where `kwargs` go to `rclpy.node.Node`
    (`cli_args`, `parameter_overrides`, `namespace`, `context`): so the same class runs alone and composed.
    """

    def __init__(self, name: str, parameters: type[T], on_change: Callable[[T], None] | None = None,
                 **kwargs: Any) -> None:
        self._unwatched: set[Subscription] = set()
        super().__init__(name, **kwargs)
        try:
            self._parameters_of_node = Parameters(self, parameters, on_change)
        except ConfigError:
            self.destroy_node()
            raise
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", qos.STATUS)

    @property
    def params(self) -> T:
        """The present parameters."""
        return self._parameters_of_node.value

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Those that the executor watches."""
        return (subscription for subscription in super().subscriptions if subscription not in self._unwatched)

    def create_backlog(self, msg_type: type, topic: str, profile: QoSProfile) -> Backlog:
        """Subscribe to a topic without being woken by its messages; `profile.depth` of them are kept."""
        backlog = Backlog(profile.depth)

        def subscribe() -> None:
            subscription = self.create_subscription(msg_type, topic, lambda _: None, profile, raw=True)
            self._unwatched.add(subscription)
            backlog.subscribe(subscription)

        composition.subscribe(self.resolve_topic_name(topic), backlog.keep, subscribe)
        return backlog

    def publish_diagnostics(self, time: float, values: dict[str, Any], level: int = 0, message: str = "ok") -> None:
        """Publish one status of this node on /diagnostics.

        Args:
            time: simulation time [s].
            values: what to show; numbers are written with six digits.
            level: 0 ok, 1 warning, 2 error.
            message: one line for people.
        """
        status = DiagnosticStatus(level=bytes([level]), name=self.get_fully_qualified_name(), message=message,
                                  hardware_id="perch")
        status.values = [KeyValue(key=key, value=f"{v:.6g}" if isinstance(v, float) else str(v))
                         for key, v in values.items()]
        array = DiagnosticArray(status=[status])
        array.header.stamp = to_stamp(float(time))
        self._diagnostics.publish(array)


class StopSignal:
    """Becomes true with SIGINT or SIGTERM.

    rclpy's own handlers end a wait by an exception out of whatever callback runs, which EventsExecutor cannot pass on;
    a flag lets the callback finish.
    """

    def __init__(self) -> None:
        self._set = False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._handle)

    def _handle(self, *_: Any) -> None:
        self._set = True

    def __bool__(self) -> bool:
        return self._set


def spin_until_stopped(executor: EventsExecutor, stop: StopSignal) -> None:
    """Run callbacks until the signal.

    EventsExecutor.spin() does not return on shutdown in rclpy 7.1.6, and spin_once() starts anew for every message, which
    costs 30 us of each; so it waits, a tenth of a second at a time, for a future. The time limit is looked at only when nothing
    waits to be called, which in lockstep may never be: there a timer completes the future.
    """
    stopped = Future()

    def look() -> None:
        if stop and not stopped.done():
            stopped.set_result(None)

    next(iter(executor.get_nodes())).create_timer(LOOK, look, clock=Clock(clock_type=ClockType.STEADY_TIME))
    while not stop and rclpy.ok():
        executor.spin_until_future_complete(stopped, timeout_sec=LOOK)


def settle() -> None:
    """Call when all nodes are there: does at once what would hold up a callback later."""
    inspect.getmodule(inspect.currentframe())  # the first line of a log looks for the files of all modules: 0.1 s
    freeze_heap()


def close_nodes(nodes: Sequence[Node]) -> None:
    """Free threads, processes and files of the nodes, the last one's first, then the nodes: all, whatever one of them raises."""
    with ExitStack() as endings:
        for node in nodes:
            endings.callback(node.destroy_node)
        for node in nodes:
            if (close := getattr(node, "close", None)) is not None:
                endings.callback(close)


def spin_main(create: Callable[..., Node], args: list[str] | None = None) -> None:
    """Run one node until SIGINT or SIGTERM; exits the process with 0, or 2 when the caller's parameters are refused."""
    stop = StopSignal()
    try:
        _check_parameter_files(sys.argv if args is None else args)
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = create()
    except (ConfigError, rclpy.exceptions.InvalidParameterValueException) as error:
        _refuse(str(error))
    except RuntimeError as error:  # rcl refuses command lines and parameter files with this one
        _refuse(" ".join(str(error).split()))
    priority.nodes = 1
    settle()
    executor = EventsExecutor()
    executor.add_node(node)
    try:
        spin_until_stopped(executor, stop)
    finally:
        close_nodes([node])
        rclpy.try_shutdown()
    sys.exit(0)


def _check_parameter_files(arguments: Sequence[str]) -> None:
    """rcl's own complaint about a missing file names a line of its C code too."""
    for option, file in zip(arguments, arguments[1:]):
        if option == "--params-file" and not os.path.isfile(file):
            raise ConfigError(option, file, "no such file")


def _refuse(problem: str) -> NoReturn:
    print(f"error: {problem}", file=sys.stderr)
    rclpy.try_shutdown()
    sys.exit(2)
