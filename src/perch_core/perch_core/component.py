"""Contract of a component: the work of a node, without ROS and without a clock.

A component takes typed values on its inputs and emits typed values on its outputs. Its time is the newest stamp that it has
received; it never reads a clock. A *host* moves values between components. There are three hosts, each one class for all
components, and a component works the same under each of them:

* **arrival** (`perch_core.ros.arrival`): each message that arrives is passed to the component, and its outputs are published;
* **lockstep** (`perch_sim.ros`): the same node, its inputs ordered by the simulator's schedule;
* **in process** (`perch_eval.in_process`): components and schedule in one loop, without ROS.

    class Estimator(Component[UkfConfig]):
        imu = Input(ImuSample, "imu/data_raw")
        odometry = Output(OdometryState, "odometry")

        def on_imu(self, sample: ImuSample) -> None:
            ...
            self.odometry(state)

A value beyond the limits of its type (`perch_core.values.limits`) does not reach `on_<name>`: under every host it is refused with
a warning that names channel, field, value and range. Inputs with `answered=True` are the exception.

A port's *channel* is the topic's relative name. `{name}` in it stands for the parameter `name` of the component.
`perch_core.ros.topics` defines once per channel its ROS message, its QoS and the conversion to and from values.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import wraps
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar, overload

from perch_core.job import Job, run_now
from perch_core.values.limits import LIMITS, problem

C = TypeVar("C")
V = TypeVar("V")
Q = TypeVar("Q")
A = TypeVar("A")


class _Port:
    """Base of all ports: the name of the attribute that declares the port, and its channel."""

    def __init__(self, channel: str) -> None:
        self._channel, self.name = channel, ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def channel(self, component: Component[Any]) -> str:
        """Return the channel, with the component's parameters in place of `{...}`."""
        if "{" not in self._channel:
            return self._channel
        return self._channel.format(**vars(component.config))

    def handler(self, component: Component[Any]) -> Callable[..., Any]:
        """Return the bound method `on_<name>`."""
        handler: Callable[..., Any] = getattr(component, f"on_{self.name}")
        return handler


class Input(_Port, Generic[V]):
    """Input port: the host passes each value to `on_<name>(value)`, in the order in which it has them."""

    def __init__(self, value: type[V], channel: str, *, lazy: bool = False, answered: bool = False) -> None:
        """
        Args:
            value: type of the values.
            channel: relative name of the topic.
            lazy: values may wait until the next input that is not lazy, at most a few hundredths of a second: a message that
                wakes its node costs far more than one that is read together with another (docs/real_time.md).
            answered: the component checks the limits itself, because it answers refused values, too.
        """
        super().__init__(channel)
        self.value, self.lazy, self.answered = value, lazy, answered


class Output(_Port, Generic[V]):
    """Output port: the component emits a value by `self.<name>(value)`."""

    def __init__(self, value: type[V], channel: str) -> None:
        super().__init__(channel)
        self.value = value

    if TYPE_CHECKING:  # an instance holds an emitter under the port's name

        @overload
        def __get__(self, instance: None, owner: type) -> Output[V]: ...
        @overload
        def __get__(self, instance: Component[Any], owner: type) -> Emitter[V]: ...
        def __get__(self, instance: Component[Any] | None, owner: type) -> Output[V] | Emitter[V]: ...


class Emitter(Generic[V]):
    """Output of one component; a call passes the value to every receiver."""

    __slots__ = ("receivers", "receiver_check")

    def __init__(self) -> None:
        self.receivers: list[Callable[[V], None]] = []
        self.receiver_check: Callable[[], bool] | None = None  # set by a host that can check whether there are subscribers

    def __call__(self, value: V) -> None:
        for receive in self.receivers:
            receive(value)

    @property
    def has_receivers(self) -> bool:
        """Whether a value would have a receiver; without one, the component may skip costly values."""
        return bool(self.receivers) if self.receiver_check is None else self.receiver_check()


class Timer(_Port):
    """Periodic call of `on_<name>(now)` with a time [ns] that does not jump where a clock is set, also while no input arrives.

    This time may differ from that of the stamps: compare it only with itself. Where it is not simulation time, it is when the call
    was due, at a multiple of the period; a late call does not shift those that follow.
    """

    def __init__(self, period: float, stamping: bool = False) -> None:
        """
        Args:
            period: interval between calls [s].
            stamping: `now` is a stamp by the host's clock instead, and jumps where that is set.
        """
        super().__init__("")
        self.period, self.stamping = period, stamping


class Service(_Port, Generic[Q, A]):
    """Service port: `on_<name>(request, reply)` takes a request; `reply(answer)` sends its one answer, at once or later."""

    def __init__(self, request: type[Q], answer: type[A], channel: str) -> None:
        super().__init__(channel)
        self.request, self.answer = request, answer


class Client(_Port, Generic[Q, A]):
    """Client port: `self.<name>(request, due)` sends a request; the answer is passed to `on_<name>(request, answer)`.

    In simulation, where work takes no simulated time, the answer is delivered at the stamp `due` [ns]; elsewhere, as soon as it
    is available. Where the server is missing, fails or does not answer within 50 s, the answer is `Unavailable`.
    """

    def __init__(self, request: type[Q], answer: type[A], channel: str) -> None:
        super().__init__(channel)
        self.request, self.answer = request, answer

    if TYPE_CHECKING:  # an instance holds under the port's name what the host has put there

        def __get__(self, instance: Component[Any], owner: type) -> Callable[[Q, int], None]: ...


@dataclass(frozen=True)
class Unavailable:
    """Answer to a request whose server is missing or has failed; `reason` is for people."""

    reason: str


class Goal(Protocol):
    """An active goal, as the host passes it to `on_<name>`.

    Attributes:
        value: the goal itself.
        cancel_requested: whether the client has requested its cancellation.
    """

    value: Any
    cancel_requested: bool

    def feedback(self, value: Any) -> None:
        """Send feedback to the client."""

    def finish(self, ending: str, result: Any) -> None:
        """End the goal, once. `ending`: "succeeded", "cancelled" or "aborted"."""


class Action(_Port):
    """Action port: `on_<name>(goal)` takes a `Goal` and returns the reason for its rejection, or an empty string."""

    def __init__(self, goal: type, feedback: type, result: type, channel: str) -> None:
        super().__init__(channel)
        self.goal, self.feedback, self.result = goal, feedback, result


@dataclass(frozen=True)
class LogLine:
    """A log line. `level`: debug, info, warning or error. `min_interval`: least wall-clock time between lines of its kind [s]."""

    level: str
    text: str
    min_interval: float = 0.0


@dataclass(frozen=True)
class Diagnostics:
    """Health of a component, emitted about once a second.

    Attributes:
        stamp: [ns].
        values: name -> number or word; names carry the unit (`_ms`, `_s`). The host adds the durations of its calls.
        level: 0 ok, 1 warning, 2 error.
        message: one line for people.
    """

    stamp: int
    values: dict[str, Any] = field(default_factory=dict)
    level: int = 0
    message: str = "ok"


class Component(Generic[C]):
    """Base of all components. A subclass declares its ports as class attributes and has a frozen dataclass of parameters.

    Attributes:
        config_type: the parameters' class, set by the subclass.
        config: the current parameters.
        work: submits a `Job`; set by the host. The default, `run_now`, runs it at once.
    """

    config_type: ClassVar[type]

    log = Output(LogLine, "rosout")
    diagnostics = Output(Diagnostics, "/diagnostics")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Wrap each handler of values that have limits in a check of these limits."""
        super().__init_subclass__(**kwargs)
        for port in ports(cls, Input):
            handler = vars(cls).get(f"on_{port.name}")
            if handler is not None and port.value in LIMITS and not port.answered:
                setattr(cls, f"on_{port.name}", _with_limit_check(port, handler))

    def __init__(self, config: C) -> None:
        """
        Raises:
            ConfigError: a parameter names something that does not exist, such as a file.
        """
        self.config = config
        self.work: Callable[[Job], None] = run_now
        for port in ports(type(self), Output):
            self.__dict__[port.name] = Emitter()

    def warm_up(self) -> None:
        """Load or compile everything that would cause delays in flight; the host calls it before the first input."""

    def preload(self) -> Callable[[], None] | None:
        """Return a picklable function that loads everything isolated jobs use, or None.

        A host with processes for isolated jobs passes it to `perch_core.isolated.IsolatedRunner`.
        """
        return None

    def reconfigure(self, config: C) -> None:
        """Apply new parameters in flight; only those named in `changeable` can differ.

        Raises:
            PerchError: a value is refused; the old parameters remain in effect. After any other exception the host applies them again.
        """
        self.config = config

    changeable: ClassVar[tuple[str, ...]] = ()
    """Dotted names of parameters that may change in flight, or prefixes with a trailing dot; `("",)`: all."""

    def close(self) -> None:
        """Release the resources of the component: files, processes, sockets."""

    def info(self, text: str) -> None:
        """Log a line."""
        self.log(LogLine("info", text))

    def warn(self, text: str, min_interval: float = 0.0) -> None:
        """Log a warning, at most one of its kind per `min_interval` [s]."""
        self.log(LogLine("warning", text, min_interval))


def _with_limit_check(port: Input[V], handler: Callable[[Any, V], None]) -> Callable[[Any, V], None]:
    @wraps(handler)
    def checked(self: Component[Any], value: V) -> None:
        if reason := problem(value):
            self.warn(f"{port.channel(self)}: {reason}: refused", min_interval=1.0)
        else:
            handler(self, value)

    return checked


P = TypeVar("P", bound=_Port)


def ports(component: type[Component[Any]], kind: type[P]) -> Iterator[P]:
    """Yield the ports of a class, in the order of their declaration, those of its bases first."""
    found: dict[str, Any] = {}
    for cls in reversed(component.__mro__):
        for name, value in vars(cls).items():
            if isinstance(value, _Port):
                found[name] = value
            elif name in found:
                del found[name]
    for value in found.values():
        if isinstance(value, kind):
            yield value
