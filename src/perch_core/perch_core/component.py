"""The contract of a component: what a node does, without ROS and without a clock.

A component takes typed values on its inputs and emits typed values on its outputs. Time is the newest stamp that it was
given; it never asks what time it is. What moves values between components is a *host*; there are three, each one class for all
components, and a component cannot tell which one it has:

* **arrival** (`perch_core.ros.arrival`): a ROS message comes in, the component works, its outputs are published;
* **lockstep** (`perch_sim.ros`): the same node, its inputs ordered by the simulator's schedule;
* **in process** (`perch_eval.in_process`): components and schedule in one loop, without ROS.

    class Estimator(Component[UkfConfig]):
        imu = Input(ImuSample, "imu/data_raw")
        odometry = Output(OdometryState, "odometry")

        def on_imu(self, sample: ImuSample) -> None:
            ...
            self.odometry(state)

What is beyond the limits of its type (`perch_core.values.limits`) never reaches `on_<name>`: it is refused at the door, with one
warning that names channel, field, value and range, whichever host brings it.

A port's *channel* is the topic's relative name. `{name}` in it stands for the parameter `name` of the component. Which ROS
message a channel carries, with which QoS, and how it becomes a value, is written once per channel in `perch_core.ros.topics`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import wraps
from typing import TYPE_CHECKING, Any, ClassVar, Generic, Protocol, TypeVar, overload

from perch_core.errors import PerchError
from perch_core.values.limits import LIMITS, problem

C = TypeVar("C")
V = TypeVar("V")
Q = TypeVar("Q")
A = TypeVar("A")


class _Port:
    """What all ports share: the name of the attribute that declares it, and its channel."""

    def __init__(self, channel: str) -> None:
        self._channel, self.name = channel, ""

    def __set_name__(self, owner: type, name: str) -> None:
        self.name = name

    def channel(self, component: Component[Any]) -> str:
        """The channel, with the component's parameters in the place of `{...}`."""
        if "{" not in self._channel:
            return self._channel
        return self._channel.format(**vars(component.config))

    def handler(self, component: Component[Any]) -> Callable[..., Any]:
        """The bound method `on_<name>`."""
        handler: Callable[..., Any] = getattr(component, f"on_{self.name}")
        return handler


class Input(_Port, Generic[V]):
    """Values that the component takes by `on_<name>(value)`, in the order in which the host has them."""

    def __init__(self, value: type[V], channel: str, *, lazy: bool = False, answered: bool = False) -> None:
        """
        Args:
            value: type of the values.
            channel: relative name of the topic.
            lazy: values need not be delivered when they arrive, only before the next input that is not lazy, and every few
                hundredths of a second: a message that wakes a process costs 50 to 100 us, one that is taken with another 5.
            answered: the component refuses nonsense itself, because it answers it.
        """
        super().__init__(channel)
        self.value, self.lazy, self.answered = value, lazy, answered


class Output(_Port, Generic[V]):
    """Values that the component emits by `self.<name>(value)`."""

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
    """An output of one component; a call hands the value to every receiver."""

    __slots__ = ("receivers", "asked")

    def __init__(self) -> None:
        self.receivers: list[Callable[[V], None]] = []
        self.asked: Callable[[], bool] | None = None  # set by a host that can tell whether anybody listens

    def __call__(self, value: V) -> None:
        for receive in self.receivers:
            receive(value)

    @property
    def wanted(self) -> bool:
        """Whether anybody would receive a value: what is costly to make need not be made for nobody."""
        return bool(self.receivers) if self.asked is None else self.asked()


class Wake(_Port):
    """Calls `on_<name>(now)` periodically with the host's time [ns], whether or not inputs come: silence is an input, too.

    The host's time need not be that of the stamps: compare it with itself only.
    """

    def __init__(self, period: float) -> None:
        """
        Args:
            period: [s].
        """
        super().__init__("")
        self.period = period


class Service(_Port, Generic[Q, A]):
    """Requests that are answered once each, now or later: `on_<name>(request, reply)`; `reply(answer)` sends the answer."""

    def __init__(self, request: type[Q], answer: type[A], channel: str) -> None:
        super().__init__(channel)
        self.request, self.answer = request, answer


class Client(_Port, Generic[Q, A]):
    """Requests to another component: `self.<name>(request, due)`; the answer comes to `on_<name>(answer)`.

    `due` [ns] is the stamp from which on the answer counts in simulation, where work takes no time of its own; elsewhere it comes
    when it is there. A server that is missing or fails answers with `Unavailable`.
    """

    def __init__(self, request: type[Q], answer: type[A], channel: str) -> None:
        super().__init__(channel)
        self.request, self.answer = request, answer

    if TYPE_CHECKING:  # an instance holds under the port's name what the host has put there

        def __get__(self, instance: Component[Any], owner: type) -> Callable[[Q, int], None]: ...


@dataclass(frozen=True)
class Unavailable:
    """The answer in the place of one that cannot be had; `reason` for people."""

    reason: str


class Goal(Protocol):
    """A goal under way, as the host hands it to `on_<name>`.

    Attributes:
        value: what is asked for.
        cancel_requested: whoever sent it wants it to end.
    """

    value: Any
    cancel_requested: bool

    def feedback(self, value: Any) -> None:
        """Tell whoever sent it how it goes."""

    def finish(self, ending: str, result: Any) -> None:
        """End it; once. `ending`: "succeeded", "cancelled" or "aborted"."""


class Action(_Port):
    """Goals: `on_<name>(goal)` takes a `Goal`, and returns why it is rejected, or an empty string."""

    def __init__(self, goal: type, feedback: type, result: type, channel: str) -> None:
        super().__init__(channel)
        self.goal, self.feedback, self.result = goal, feedback, result


class JobStopped(PerchError):
    """A job was stopped at its limit."""


class JobFailed(PerchError):
    """An isolated job ended without an answer: its process crashed, ran out of memory, or raised what nobody had foreseen."""


@dataclass(frozen=True)
class Job:
    """Long work that the host runs elsewhere: `function(*arguments)`.

    Attributes:
        function: of a module; it must be picklable, and so must `arguments` and what it returns, where `isolated`.
        arguments: its arguments.
        then: called on the component's thread with what it returned, or with the exception that ended it.
        limit: wall-clock time from when the host was given it, after which it is stopped, which ends it with `JobStopped` [s];
            None: never. The jobs before it count.
        isolated: run in a process that can be killed; otherwise on a thread, which a limit cannot stop.
    """

    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    then: Callable[[Any], None]
    limit: float | None = None
    isolated: bool = False


def run_now(job: Job) -> None:
    """A job where nobody waits for anything else: at once, on the caller's thread, without a limit."""
    try:
        result = job.function(*job.arguments)
    except PerchError as error:
        result = error
    job.then(result)


@dataclass(frozen=True)
class LogLine:
    """A line for people. `level`: debug, info, warning, error. `every`: at most one of this text in so many seconds of wall-clock time."""

    level: str
    text: str
    every: float = 0.0


@dataclass(frozen=True)
class Diagnostics:
    """How a component is, about once a second.

    Attributes:
        stamp: [ns].
        values: name -> number or word; names carry the unit (`_ms`, `_s`). The host adds what its calls took.
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
        config: the present parameters.
        work: gives a `Job` to the host; the host sets it, on its own a component works at once.
    """

    config_type: ClassVar[type]

    log = Output(LogLine, "rosout")
    diagnostics = Output(Diagnostics, "/diagnostics")

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """Put a door before each handler of values that have limits."""
        super().__init_subclass__(**kwargs)
        for port in ports(cls, Input):
            take = vars(cls).get(f"on_{port.name}")
            if take is not None and port.value in LIMITS and not port.answered:
                setattr(cls, f"on_{port.name}", _behind_a_door(port, take))

    def __init__(self, config: C) -> None:
        """
        Raises:
            ConfigError: a parameter names what is not there.
        """
        self.config = config
        self.work: Callable[[Job], None] = run_now
        for port in ports(type(self), Output):
            self.__dict__[port.name] = Emitter()

    def warm_up(self) -> None:
        """Load or compile what would hold up a flight; the host calls it before the first input."""

    def preload(self) -> Callable[[], None] | None:
        """What loads all that isolated jobs use, picklable; None: nothing.

        A host with processes for isolated jobs gives it to `perch_core.isolated.IsolatedRunner`, another calls it after `warm_up`.
        """
        return None

    def reconfigure(self, config: C) -> None:
        """Take new parameters in flight; only those that the class names in `changeable` differ.

        Raises:
            ConfigError: a value is refused; the old ones stay.
        """
        self.config = config

    changeable: ClassVar[tuple[str, ...]] = ()
    """Dotted names, or their beginnings with a trailing dot, of parameters that may change in flight; `("",)`: all."""

    def close(self) -> None:
        """Free what the component holds: files, processes, sockets."""

    def info(self, text: str) -> None:
        """Log a line."""
        self.log(LogLine("info", text))

    def warn(self, text: str, every: float = 0.0) -> None:
        """Log a warning, at most one of its kind in `every` seconds."""
        self.log(LogLine("warning", text, every))


def _behind_a_door(port: Input[V], take: Callable[[Any, V], None]) -> Callable[[Any, V], None]:
    @wraps(take)
    def taken(self: Component[Any], value: V) -> None:
        if said := problem(value):
            self.warn(f"{port.channel(self)}: {said}: refused", every=1.0)
        else:
            take(self, value)

    return taken


P = TypeVar("P", bound=_Port)


def ports(component: type[Component[Any]], kind: type[P]) -> Iterator[P]:
    """The ports of a class, in the order of their declaration, those of its bases first."""
    seen: dict[str, Any] = {}
    for cls in reversed(component.__mro__):
        for name, value in vars(cls).items():
            if isinstance(value, _Port):
                seen[name] = value
            elif name in seen:
                del seen[name]
    for value in seen.values():
        if isinstance(value, kind):
            yield value
