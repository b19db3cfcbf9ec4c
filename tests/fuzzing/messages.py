"""Messages to every input of every component, in process: valid streams of a flight, and spoilt messages between their values.

Two games are played. In *nonsense*, some field of each spoilt message makes no sense at all (NaN, 1e308, a quaternion of norm 0, a frame
that does not exist, a stamp of 2038, a negative covariance): it must be refused with a word, and whatever is flown or estimated must be
the same to the last bit as without it. In *anything*, fields are changed in any way, many at once: what is taken may move the outputs,
but these stay finite, normalised and within what the vehicle can do. In both, nothing but a `PerchError` leaves a component, no call
takes 2 s, and memory stays bounded.
"""

from __future__ import annotations

import json
import os
import random
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

from perch_core.component import Input, Output, ports
from perch_core.errors import PerchError
from perch_core.isolated import IsolatedRunner
from perch_core.job import Job, JobFailed, JobStopped
from perch_core.ros import topics
from rclpy.serialization import deserialize_message
from fuzzing import sense
from fuzzing.report import Report
from fuzzing.spoiled import Way, in_effect, senseless, some_way, spoilt
from fuzzing.streams import FLIGHTS, Event, component, is_rendered, recorded

SLOW = 2.0        # of processor time [s]
HUNG = 600.0      # of the wall clock, for a whole game [s]
MEMORY = 1 << 30  # by which the calls of a game may let the process grow [byte]
WORDLESS = 300    # events within which something must have been said of what makes no sense
EVENTS = 2000     # of a game, on an average
SHRINKING = 20.0  # for the search of a smaller case [s]

FREE: dict[str, tuple[str, ...]] = {
    "Imu": ("orientation", "angular_velocity_covariance", "linear_acceleration_covariance"),
    "EstimatorStatus": ("header", "vio_age", "updates", "nis", "gyro_bias", "accel_bias", "position_sigma", "attitude_sigma"),
    "ControllerStatus": ("header", "trajectory_duration", "position_error", "odometry_age", "thrust_margin", "thrust_ratio"),
    "ControllerCommand": ("header",), "MotorCommand": ("header",), "RotorState": ("header",), "PowerlineArray": ("lines.0.covariance",),
    "CameraInfo": ("header", "r", "p", "roi", "binning"), "Image": ("header.frame_id",), "TFMessage": ("transforms.0.header", "transforms.0.child_frame_id"),
    "Odometry": ("child_frame_id", "pose.covariance", "twist.covariance"), "Trajectory": ("recovery_start",), "VioState": (),
}
"""Message -> beginnings of fields that mean nothing to some who take it, or hold values that look senseless in use."""

PRIMARY: dict[str, Callable[[str, Any], Any]] = {
    "estimator": lambda port, x: (x.stamp, x.p_WB, x.q_WB, x.v_B, x.w_B) if port == "odometry" else None,
    "controller": lambda port, x: x if port == "motor_command" else None,
    "mission": lambda port, x: x if port in ("trajectory", "recovery", "command") else None,
    "vio": lambda port, x: (x.stamp, x.p_WB, x.q_WB) if port == "state" else None,
    "target_localizer": lambda port, x: x if port == "pose" else None,
    "powerline_mapper": lambda port, x: None,
    "vehicle": lambda port, x: x if port == "imu" else None,
    "vio_model": lambda port, x: None,  # a stand-in believes every stamp of the truth
    "description": lambda port, x: x,
}
"""Component -> what of an output must be the same whatever nonsense came; None: nothing."""
ANSWERED = {("controller", "odometry")}
"""Inputs each of whose values is answered, nonsense too."""


class Spoilt(NamedTuple):
    """A spoilt message: sent before event `at`, made of the value of event `of`."""

    at: int
    of: int
    ways: tuple[Way, ...]


class Nonsense(PerchError):
    """A component did what makes no sense; `case` is the game that led to it, as JSON."""

    def __init__(self, problem: str, case: str = "") -> None:
        super().__init__(problem)
        self.case = case


class _Played:
    """A component under way in a game."""

    def __init__(self, flight: str, name: str) -> None:
        self.name, self.component = name, component(flight, name)
        self.words, self.problem, self.grown = 0, "", 0  # bytes, while it was called
        self._pages = open("/proc/self/statm", "rb", buffering=0)  # read at each call: psutil takes ten times as long
        self.outputs: list[Any] = []
        vehicle = getattr(self.component, "_vehicle", None)
        self._turned = 2e-3 if name == "vio_model" else 1e-6  # the stand-in hands on the truth as it is
        self._speed_max = float(getattr(vehicle, "speed_max", 3000.0))
        for port in ports(type(self.component), Output):
            getattr(self.component, port.name).receivers.append(self._receiver(port.name))

    def _receiver(self, port: str) -> Callable[[Any], None]:
        primary = PRIMARY[self.name]

        def receive(value: Any) -> None:
            if port == "log":
                self.words += value.level in ("warning", "error") or "refused" in value.text
                return
            if port not in ("debug_image", "robot_description") and not port.startswith("image_"):
                self.problem = self.problem or next(sense.nonsense(value, self._speed_max, port, self._turned), "")
            kept = primary(port, value)
            if kept is not None:
                self.outputs.append((port, kept))

        return receive

    def _resident(self) -> int:
        """Memory of this process [byte]."""
        return int(os.pread(self._pages.fileno(), 100, 0).split()[1]) * os.sysconf("SC_PAGE_SIZE")

    def call(self, method: str, arguments: Sequence[Any]) -> str:
        """Call the component.

        Returns:
            `refused` where a PerchError came or something was said, else `taken`.

        Raises:
            Nonsense: with what went wrong.
        """
        words, memory, began = self.words, self._resident(), time.thread_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)
                getattr(self.component, method)(*arguments)
        except PerchError:
            self.words += 1
        except Exception:
            raise Nonsense(f"{method}: {traceback.format_exc()}") from None
        self.grown += self._resident() - memory
        if (took := time.thread_time() - began) > SLOW:
            raise Nonsense(f"{method} took {took:.1f} s")
        if self.problem:
            raise Nonsense(f"after {method}: {self.problem}")
        return "refused" if self.words > words else "taken"


class _Goal:
    """A goal of the stream."""

    def __init__(self, value: Any) -> None:
        self.value, self.cancel_requested, self.feedback = value, False, lambda told: None

    def finish(self, ending: str, result: Any) -> None:
        """It ends."""


def _handed(event: Event) -> tuple[Any, ...]:
    return (_Goal(event.arguments[0]),) if event.method == "on_perch" else event.arguments


def inputs_of(flight: str, name: str) -> dict[str, tuple[str, list[int]]]:
    """Method -> channel and the events that bring it, for every input of a component that a flight has values of."""
    one = component(flight, name)
    found = {f"on_{port.name}": (port.channel(one), []) for port in ports(type(one), Input)}
    for k, event in enumerate(recorded(flight)[name]):
        if event.method in found:
            found[event.method][1].append(k)
    return {method: entry for method, entry in found.items() if entry[1]}


@lru_cache(maxsize=None)
def _message(flight: str, name: str, channel: str, k: int) -> Any:
    value = recorded(flight)[name][k].arguments[0]
    return deserialize_message(topics.encode(channel, value), topics.message_type(channel))


def _on_the_wire(message: Any) -> bytes:
    """A message as it is sent; empty: the middleware has no memory for it, and nobody could send it."""
    try:
        return topics.serialize_message(message)
    except RuntimeError:
        return b""


def is_free(message: Any, way: Way) -> bool:
    """Whether a field means nothing."""
    if getattr(message, "armed", True) is False:
        return True
    name = ".".join(map(str, way.path))
    return any(name.startswith(beginning) for beginning in FREE.get(type(message).__name__, ()))


def play(flight: str, name: str, sent: Sequence[Spoilt], strict: bool, last: int) -> Counter[str]:
    """A game: the events of a flight, and spoilt messages before some of them.

    Args:
        flight, name: of the component.
        sent: in order of `at`.
        strict: whether they make no sense, so that outputs stay as they are and something is said of each.
        last: events.

    Returns:
        How many were refused and how many taken.

    Raises:
        Nonsense: with the case.
    """
    events, one, count = recorded(flight)[name], _Played(flight, name), Counter()
    queue, unsaid = list(reversed(sent)), -1
    channels = inputs_of(flight, name)
    for k, event in enumerate(events[:last]):
        while queue and queue[-1].at <= k:
            spoil = queue.pop()
            method = events[spoil.of].method
            channel = channels[method][0]
            data = _on_the_wire(spoilt(_message(flight, name, channel, spoil.of), list(spoil.ways)))
            if not data:
                continue
            outcome, began = "refused", time.thread_time()
            try:
                value = topics.topic(channel).read(data)
                received = value if isinstance(value, list) else [value]
            except PerchError:
                received = []
            except Exception:
                raise Nonsense(f"{channel}: {traceback.format_exc()}") from None
            if (took := time.thread_time() - began) > SLOW:
                raise Nonsense(f"{channel}: took {took:.1f} s to read")
            for value in received:
                outcome = one.call(method, (value,))
            count[outcome] += 1
            if strict and outcome == "taken" and unsaid < 0:
                unsaid = k
        outcome = one.call(event.method, _handed(event))
        count["valid"] += 1
        if outcome == "refused":
            unsaid = -1
        if 0 <= unsaid < k - WORDLESS:
            raise Nonsense(f"taken without a word: {next(s for s in sent if s.at == unsaid)}")
    if one.grown > MEMORY:
        raise Nonsense(f"grown by {one.grown / 1e6:.0f} MB")
    if strict and not sense.same(one.outputs, _untouched(flight, name, last)):
        first = next((k for k, pair in enumerate(zip(one.outputs, _untouched(flight, name, last))) if not sense.same(*pair)), -1)
        raise Nonsense(f"nonsense has moved the outputs, from the {first}th on: {[str(way) for s in sent[-3:] for way in s.ways]}")
    one.component.close()
    return count


@lru_cache(maxsize=None)
def _undisturbed(flight: str, name: str) -> tuple[_Played, list[int]]:
    """A game in which nothing is sent, as far as it was played, and how many outputs there were after so many events."""
    return _Played(flight, name), [0]


def _untouched(flight: str, name: str, last: int) -> list[Any]:
    one, counts = _undisturbed(flight, name)
    for event in recorded(flight)[name][len(counts) - 1:last]:
        one.call(event.method, _handed(event))
        counts.append(len(one.outputs))
    return one.outputs[:counts[last]]


@lru_cache(maxsize=8)
def drawn(flight: str, name: str, seed: int) -> tuple[list[Spoilt], bool, int]:
    """What is sent in a game of a seed, whether it makes no sense, and how many events there are."""
    rng = random.Random(seed)
    events, strict = recorded(flight)[name], rng.random() < 0.4
    last = min(len(events), rng.randrange(200, 2 * EVENTS))
    inputs = {method: entry for method, entry in inputs_of(flight, name).items() if not strict or (name, method[3:]) not in ANSWERED}
    sent: list[Spoilt] = []
    for _ in range(rng.choice((3, 10)) if strict else rng.choice((10, 100, 1000, 3000))):
        method = rng.choice(list(inputs))
        channel, places = inputs[method]
        of = rng.choice(places)
        at = rng.randrange(last) if strict else min(last - 1, max(0, of + rng.randrange(-20, 20)) if of < last else rng.randrange(last))
        message = _message(flight, name, channel, of)
        for _ in range(200):
            ways = tuple(some_way(message, rng) for _ in range(1 if strict else rng.choice((1, 1, 1, 2, 4))))
            if not strict or (senseless(ways[0]) and not is_free(message, ways[0])
                              and in_effect(ways[0], message, spoilt(message, list(ways)))):
                sent.append(Spoilt(at, of, ways))
                break
    return sorted(sent), strict, last


def hunt(flight: str, name: str, seed: int) -> Counter[str]:
    """A game of a seed.

    Raises:
        Nonsense: with the smallest case that was found to lead to it.
    """
    sent, strict, last = drawn(flight, name, seed)
    try:
        return play(flight, name, sent, strict, last)
    except Nonsense as error:
        problem = error
    end = time.monotonic() + SHRINKING
    for fewer in (*([one] for one in reversed(sent[-20:])), *([one] for one in sent[:-20]), sent[len(sent) // 2:], sent[: len(sent) // 2]):
        if time.monotonic() > end:
            break
        try:
            play(flight, name, fewer, strict, last)
        except Nonsense as error:
            sent, problem = fewer, error
            break
    events = recorded(flight)[name]
    kept = [(one.at, events[one.of].method, one.of, one.ways) for one in sent]
    case = {"flight": flight, "component": name, "strict": strict, "last": last, "sent": kept}
    raise Nonsense(f"{flight} {name}: {problem}\n{problem.args[0].strip().splitlines()[-1]}", json.dumps(case)) from None


def replay(case: str) -> Counter[str]:
    """Play a case that was found, with the events of the same inputs that are nearest to its own: a flight changes with the code.

    Returns:
        As `play`.

    Raises:
        Nonsense: it is one still.
    """
    found = json.loads(case)
    flight, name = found["flight"], found["component"]
    inputs, events = inputs_of(flight, name), len(recorded(flight)[name])
    sent = [Spoilt(at, min(inputs[method][1], key=lambda k: abs(k - of)), tuple(Way(tuple(path), kind, value) for path, kind, value in ways))
            for at, method, of, ways in found["sent"]]
    return play(flight, name, sent, found["strict"], min(found["last"], events))


PLAYERS = [(flight, name) for flight, (_, names) in FLIGHTS.items() for name in names]


def prepared() -> None:
    """Fly what the games are played on."""
    for flight in FLIGHTS:
        recorded(flight)


def run(minutes: float, seed: int, report: Report) -> None:
    """Hunt, in a process that may crash or hang."""
    rng, runner = random.Random(seed), IsolatedRunner(preload=prepared)
    players = [player for player in PLAYERS for _ in range(1 if is_rendered(player[0]) else 3)]
    try:
        while not runner.wait_ready():  # on a busy machine the flights for the games take minutes
            pass
        report.begin()
        while report.going():
            flight, name = rng.choice(players)
            game = rng.randrange(2**31)
            try:
                for outcome, count in runner.submit(Job(hunt, (flight, name, game), then=id, limit=HUNG)).result(2 * HUNG).items():
                    report.tried(outcome, count)
            except Nonsense as error:
                report.found(f"{name}.json", error.case.encode(), str(error))
            except (JobFailed, JobStopped, TimeoutError) as error:
                if "not begun" in str(error):
                    continue
                report.found(f"{name}.json", json.dumps({"flight": flight, "component": name, "seed": game}).encode(), f"{name}: {error}")
    finally:
        runner.close()
