"""ROS side of a component, shared by both ROS hosts: parameters, outputs, services, actions, clients, jobs, log, diagnostics."""

from __future__ import annotations

import os
import re
import socket
import time
import traceback
from collections import defaultdict, deque
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import lru_cache, partial
from typing import Any

for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ[_variable] = "1"  # one core per node, and the same sums in every flight; before numpy is imported

from perch_core.component import Action, Component, Diagnostics, Emitter, LogLine, Output, Service, ports
from perch_core.errors import ConfigError, PerchError
from perch_core.ros import topics
from perch_core.ros.deadlines import durations_us
from perch_core.ros.goal_server import GoalServer, ServedGoal
from perch_core.ros.jobs import Jobs
from perch_core.ros.late_service import LateService
from perch_core.ros.messages.diagnostics import diagnostics_message
from perch_core.ros.parameters import Parameters
from perch_core.ros.wiring import Publication, Wiring, foreign_publishers, is_observer
from rclpy.action import GoalResponse
from rclpy.clock import Clock, ClockType
from rcl_interfaces.msg import SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.subscription import Subscription
from rosgraph_msgs.msg import Clock as ClockMessage

INTERNAL_OUTPUTS = ("log", "diagnostics")  # outputs that are no topics of their own
DURATIONS_KEPT = 300    # calls whose durations are kept
LOG_KINDS_MAX = 100     # kinds of lines whose times are kept
HEARTBEAT_PERIOD = 1.0  # of the diagnostics of a node whose component emits none [s]
CLOCK_CHECK_PERIOD = 1.0  # of the check for other publishers of the clock that this node publishes [s]
LOG_LENGTH_MAX = 300    # characters of a log line below the level error
_NUMBERS = re.compile(r"[-+.\de]*\d")  # what differs between lines of one kind


class ComponentNode(Node):
    """Node with one component and its topics. Subclasses pass the inputs to it."""

    def __init__(self, name: str, component: type[Component[Any]], wiring: Wiring, **kwargs: Any) -> None:
        """
        Args:
            name: of the node.
            component: class of the component.
            wiring: connections among the nodes of this process.
            kwargs: arguments of `rclpy.node.Node`: `cli_args`, `parameter_overrides`, `namespace`, `context`.

        Raises:
            ConfigError: a parameter is refused.
        """
        self._unwatched: set[Subscription] = set()
        super().__init__(name, **kwargs)
        self.wiring = wiring
        wiring.on_failure = self.log_refusal
        self._durations: defaultdict[str, deque[float]] = defaultdict(partial(deque, maxlen=DURATIONS_KEPT))
        self._last_logged: dict[str, float] = {}
        self._logged_once: set[str] = set()
        self._failures = 0
        self._goals: dict[str, ServedGoal] = {}
        try:
            self._typed_parameters = Parameters(self, component.config_type, component.changeable, self._reconfigure)
            self.component = component(self._typed_parameters.value)
        except ConfigError:
            self.destroy_node()
            raise
        for attribute, function in (("resolve", lru_cache(self.resolve_topic_name)), ("host_time", self.host_time)):
            if hasattr(self.component, attribute):
                setattr(self.component, attribute, function)
        self._jobs = Jobs(lambda work, *arguments: wiring.from_thread(self.guarded, "job", work, *arguments), self.component.preload())
        self.component.work = self._jobs.submit
        self.component.log.receivers.append(self._log)
        self._diagnostics = self.create_publisher(topics.message_type("/diagnostics"), "/diagnostics", topics.topic("/diagnostics").qos.publish)
        self.component.diagnostics.receivers.append(self._publish_diagnostics)
        self._last_report_time, self._last_report, self._process_name = 0.0, Diagnostics(0), f"{socket.gethostname()}:{os.getpid()}"
        self.create_timer(HEARTBEAT_PERIOD, self._publish_heartbeat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._publish_outputs()
        self.component.warm_up()

    @property
    def subscriptions(self) -> Iterator[Subscription]:
        """Subscriptions that the executor watches."""
        return (subscription for subscription in super().subscriptions if subscription not in self._unwatched)

    def create_unwatched(self, message: type, channel: str, profile: QoSProfile) -> Subscription:
        """Create a subscription whose serialised messages wait to be taken and do not wake the executor."""
        subscription = self.create_subscription(message, channel, lambda _: None, profile, raw=True)
        self._unwatched.add(subscription)
        return subscription

    def create_service(self, srv_type: Any, srv_name: str, callback: Callable[[Any, Any], Any], **kwargs: Any) -> Any:
        """As in `rclpy.node.Node`; if the callback raises an exception, it is logged, and the response is sent as it is by then.

        Such exceptions are those of rclpy itself, on a parameter of an unknown type. They would end the process.
        """
        def respond(request: Any, response: Any) -> Any:
            try:
                return callback(request, response)
            except Exception as error:
                self.log_refusal(srv_name, error)
                return response

        return super().create_service(srv_type, srv_name, respond, **kwargs)

    def host_time(self) -> int:
        """Return the time of the node's clock, simulation time if `use_sim_time` is set [ns]."""
        clock = self.get_clock().handle
        with clock:
            return int(clock.get_now().nanoseconds)  # as `Clock.now` has it, without an object of the time: this runs at 500 Hz

    def use_local_clock(self) -> None:
        """Receive simulation time as values if its publisher is in this process: messages to every node, 100 times a second,
        would delay steps. Called when all nodes of the process exist."""
        for subscription in tuple(self.subscriptions):
            if subscription.msg_type is not ClockMessage or subscription.raw:
                continue
            topic = subscription.topic_name
            if self.wiring.writer(topic) is not None:
                self.wiring.add_reader(topic, partial(self._pass_time, subscription.callback))
                self.destroy_subscription(subscription)
            else:
                subscription.callback = partial(self._check_time, subscription.callback)
        clock = self.resolve_topic_name("/clock")
        if self.wiring.writer(clock) == self.get_fully_qualified_name():
            self.create_timer(CLOCK_CHECK_PERIOD, partial(self._warn_foreign_clocks, clock), clock=Clock(clock_type=ClockType.STEADY_TIME))

    def _warn_foreign_clocks(self, clock: str) -> None:
        for publisher in foreign_publishers(self, clock, {self.get_fully_qualified_name()}):
            self.warn_once(f"{clock}: {publisher} publishes it, too: the clocks of nodes in other processes follow both")

    def _check_time(self, callback: Callable[[ClockMessage], None], message: ClockMessage) -> None:
        """Refuse a negative time, on which rclpy would raise an exception that ends the process."""
        if message.clock.sec < 0:
            self.warn_once("/clock: a negative time is ignored")
        else:
            callback(message)

    @staticmethod
    def _pass_time(callback: Callable[[ClockMessage], None], stamp: int) -> None:
        callback(topics.topic("/clock").to_message(stamp))

    # -- outputs -----------------------------------------------------------------------------------------------------

    def _publish_outputs(self) -> None:
        for port in ports(type(self.component), Output):
            if port.name in INTERNAL_OUTPUTS:
                continue
            channel = port.channel(self.component)
            try:
                row = topics.topic(channel)
            except PerchError as error:
                self.get_logger().warning(f"{error}: not published")
                continue
            publisher = self.create_publisher(row.message, channel, row.qos.publish)
            publication = Publication(publisher, row.to_message, row.latched, self.log_refusal, row.frequent, row.observed)
            emitter = getattr(self.component, port.name)
            self.wiring.register_writer(publisher.topic_name, self.get_fully_qualified_name())
            emitter.receivers.append(self._emit_function(publisher.topic_name, publication))
            emitter.receiver_check = partial(self._has_receivers, emitter, publisher.topic_name, publication, row)

    def _emit_function(self, topic: str, publication: Publication) -> Callable[[Any], None]:
        return partial(self.wiring.emit, topic, publication)

    def _has_receivers(self, emitter: Emitter[Any], topic: str, publication: Publication, row: topics.Topic) -> bool:
        """Return whether an output has a receiver: a neighbour, a subscriber, or one besides this host.

        Of commands to a vehicle, those who only observe are none.
        """
        if len(emitter.receivers) > 1 or self.wiring.has_reader(topic, observers=not row.obeyed):
            return True
        if not row.obeyed:
            return publication.has_subscribers()
        return any(not is_observer(info.node_name) for info in self.get_subscriptions_info_by_topic(topic))

    # -- requests ----------------------------------------------------------------------------------------------------

    def serve(self) -> None:
        """Wait until isolated jobs can run, then offer the component's services and actions."""
        self._jobs.wait_ready()
        for service in ports(type(self.component), Service):
            self._serve_service(service)
        for action in ports(type(self.component), Action):
            self._serve_action(action)

    def _serve_service(self, port: Service[Any, Any]) -> None:
        channel = port.channel(self.component)
        row = topics.service(channel)

        def handle_request(request: Any, answer: Callable[[Any], None]) -> None:
            try:
                value = row.request_value(request)
            except Exception as error:
                self.log_refusal(channel, error)
                answer(self._bad_request(row, str(error)))
                return
            self.dispatch(port, self.begin_request, port, row, value, answer)

        LateService(self, row.type, channel, handle_request)

    @staticmethod
    def _bad_request(row: topics.ServiceRow, reason: str) -> Any:
        response = row.type.Response(success=False, message=reason)
        if hasattr(response, "error_code"):
            response.error_code = 1  # BAD_INPUT everywhere
        return response

    def _serve_action(self, port: Action) -> None:
        channel = port.channel(self.component)
        row = topics.action(channel)

        def accept(_: Any) -> GoalResponse:
            current = self._goals.get(port.name)
            if current is not None and not current.finished:
                self.get_logger().warning(f"{channel}: goal rejected: another goal is active")
                return GoalResponse.REJECT
            return GoalResponse.ACCEPT

        def begin(handle: Any) -> None:
            goal = self._goals[port.name] = ServedGoal(server, handle, row)
            self.dispatch(port, self.begin_goal, port, goal)

        server = GoalServer(self, row.type, channel, begin, accept)

    def begin_request(self, port: Service[Any, Any], row: topics.ServiceRow, request: Any, answer: Callable[[Any], None]) -> None:
        """Pass a request to the component; if the component fails before it has answered, refuse the request."""
        answered = False

        def reply(value: Any) -> None:
            nonlocal answered
            try:
                message = row.answer_message(value)
            except Exception as error:  # replies may come later, where nobody else would answer
                self.log_refusal(row.channel, error)
                message = self._bad_request(row, f"the answer has no message: {error}")
            answer(message)
            answered = True

        try:
            port.handler(self.component)(request, reply)
        except Exception as error:
            if not answered:
                answer(self._bad_request(row, str(error)))
            raise

    def begin_goal(self, port: Action, goal: ServedGoal) -> None:
        """Pass a goal to the component; if the component rejects it or fails, end it at once."""
        try:
            reason = port.handler(self.component)(goal)
        except Exception as error:
            if not goal.finished:
                goal.reject(str(error))
            raise
        if reason:
            self.get_logger().warning(f"{port.name}: goal rejected: {reason}")
            goal.reject(reason)

    def dispatch(self, port: Service[Any, Any] | Action, work: Callable[..., None], *arguments: Any) -> None:
        """Schedule a request or a goal: call `work` with `arguments` in the order of the host."""
        raise NotImplementedError

    def connect(self) -> None:
        """Subscribe to the inputs and offer the services; called when all nodes of the process exist."""
        raise NotImplementedError

    # -- parameters --------------------------------------------------------------------------------------------------

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """As in `rclpy.node.Node`; refusals name the parameter and what is allowed. Whatever the component raises refuses the change."""
        try:
            return super().set_parameters_atomically(self._typed_parameters.checked(parameter_list))
        except PerchError as error:
            return SetParametersResult(successful=False, reason=str(error))
        except Exception as error:
            self.log_refusal("parameters", error)
            return SetParametersResult(successful=False, reason=f"{type(error).__name__}: {error}")

    def _reconfigure(self, config: Any) -> None:
        try:
            self.component.reconfigure(config)
        except PerchError:
            raise
        except Exception:  # a part of the change may be in effect
            self.component.reconfigure(self._typed_parameters.value)
            raise

    # -- log and diagnostics -----------------------------------------------------------------------------------------

    def _log(self, line: LogLine) -> None:
        if len(line.text) > LOG_LENGTH_MAX and line.level != "error":  # it may quote a received message
            line = LogLine(line.level, f"{line.text[:LOG_LENGTH_MAX]}...", line.min_interval)
        if line.min_interval:
            now, kind = time.monotonic(), _NUMBERS.sub("", line.text)
            if now - self._last_logged.get(kind, -1e9) < line.min_interval:
                return
            if len(self._last_logged) > LOG_KINDS_MAX:
                self._last_logged.clear()
            self._last_logged[kind] = now
        logger = self.get_logger()
        if line.level == "error":  # rclpy refuses one call site with two severities
            logger.error(line.text)
        elif line.level == "warning":
            logger.warning(line.text)
        elif line.level == "info":
            logger.info(line.text)
        else:
            logger.debug(line.text)

    def warn_once(self, text: str) -> None:
        """Log a warning, each text only once."""
        if text not in self._logged_once:
            self._logged_once.add(text)
            self.get_logger().warning(text)

    def _publish_heartbeat(self) -> None:
        """Repeat the last diagnostics while the component emits none, so that an idle node differs from one that hangs."""
        if time.monotonic() - self._last_report_time >= HEARTBEAT_PERIOD:
            self.repeat_diagnostics()

    def repeat_diagnostics(self) -> None:
        """Publish the component's last diagnostics again, with the host's present values."""
        self._publish_diagnostics(replace(self._last_report, stamp=self.host_time()))

    def _publish_diagnostics(self, diagnostics: Diagnostics) -> None:
        self._last_report_time, self._last_report = time.monotonic(), diagnostics
        values = dict(diagnostics.values) | self.host_diagnostics()
        for name, durations in self._durations.items():
            values |= durations_us(name, durations)
        level = diagnostics.level
        if self._failures:
            values["failures"], level = self._failures, 2
        extended = Diagnostics(diagnostics.stamp, values, level, diagnostics.message)
        message = diagnostics_message(extended, self.get_fully_qualified_name())
        message.status[0].hardware_id = self._process_name
        self._diagnostics.publish(message)

    def host_diagnostics(self) -> dict[str, Any]:
        """Return the values that the host adds to the diagnostics."""
        return {}

    def guarded(self, name: str, work: Callable[..., None], *arguments: Any) -> None:
        """Call the component and record the duration; an exception is logged, its value is dropped, and the node continues."""
        begin = time.perf_counter()
        try:
            work(*arguments)
        except Exception as error:
            self.log_refusal(name, error)
        self._durations[name].append(time.perf_counter() - begin)

    def log_refusal(self, name: str, error: Exception) -> None:
        """Log a refusal; any exception but a `PerchError` counts as a failure. Call it while the exception is being handled."""
        if isinstance(error, PerchError):
            self._log(LogLine("warning", f"{name} refused: {error}", min_interval=1.0))
            return
        self._failures += 1
        self._log(LogLine("error", f"{name}: unexpected exception, value dropped:\n{traceback.format_exc()}", min_interval=1.0))

    def close(self) -> None:
        """Release the resources of the component and its jobs."""
        self._jobs.close()
        self.component.close()
