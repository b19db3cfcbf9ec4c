"""Files of every kind, mutated in structure and byte by byte.

A file either loads to a value whose every number is within its declared range, or is refused in one line; within 2 s.
"""

from __future__ import annotations

import dataclasses
import math
import random
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perch_core import config
from perch_core.job import Job, JobFailed, JobStopped
from perch_core.errors import PerchError
from perch_core.isolated import IsolatedRunner
from perch_core.tag_board import TagBoard, load_board
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval import mcap_log
from perch_eval.campaign.specification import RUNS_MAX, Campaign, load_campaign
from perch_eval.flyable import check_flight
from fuzzing.report import Report
from perch_eval.in_process.parameters import COMPONENTS, component_class
from perch_eval.node_launch import HOST_PARAMETERS, parameters_in
from perch_planner.powerline.problem import PowerlineProblem
from perch_planner.problem_file import read_problem
from perch_sim.scenario import Scenario, load_scenario

SLOW = 2.0  # of processor time [s]
HUNG = 120.0  # of the wall clock, on a machine that has other things to do [s]
LONGEST_LINE = 3500


class Nonsense(PerchError):
    """What an oracle says of a value that should have been refused."""


def kinds() -> dict[str, list[Path]]:
    """Kind -> the repository's files of it. Parameter files are a kind each, as in `parameters.vio`; the recording is of these tests."""
    folder = config.config_dir()
    found = {kind.removesuffix("s"): sorted((folder / kind).glob("*.yaml")) for kind in ("vehicles", "scenarios", "boards", "campaigns", "problems")}
    found["recording"] = [Path(__file__).with_name("recording.mcap")]
    return found | {f"parameters.{node}": [folder / f"{node}.yaml"] for node in COMPONENTS if (folder / f"{node}.yaml").exists()}


def load(kind: str, path: Path) -> Any:
    """What the repository's readers make of a file.

    Raises:
        PerchError: it is refused.
    """
    if kind == "vehicle":
        vehicle = load_vehicle(path)
        return vehicle, vehicle.mounts
    if kind == "scenario":
        scenario = load_scenario(path)
        check_flight(scenario, path)
        return scenario
    if kind == "board":
        return load_board(path)
    if kind == "campaign":
        return load_campaign(path, runs=1)
    if kind == "problem":
        mapping = config.read_yaml(path)
        if isinstance(mapping, dict) and mapping.get("kind") == "powerline":
            problem = config.from_mapping(PowerlineProblem, mapping, str(path))
            return problem, problem.request(load_vehicle(problem.vehicle))
        return read_problem(mapping, str(path))
    if kind == "recording":
        damage: list[str] = []
        values = [*mcap_log.read(path, damage.append)]
        mcap_log.recover(path, path.with_suffix(".copy"))
        if damage:
            raise PerchError(damage[0])
        return values
    parameters = config.flattened(parameters_in(path, path.stat().st_mtime_ns))
    own = {name: value for name, value in parameters.items() if name not in HOST_PARAMETERS}
    return config.from_mapping(component_class(kind.removeprefix("parameters."), own).config_type, config.nested(own), str(path))


def judge(kind: str, content: bytes) -> str:
    """`accepted` or `refused`.

    Raises:
        Nonsense: neither in a way that makes sense; with a traceback where there is one.
    """
    with tempfile.TemporaryDirectory(prefix="perch-fuzz-") as folder:
        path = Path(folder) / "input.yaml"
        path.write_bytes(content)
        began = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error", RuntimeWarning)  # numpy's word for a division by zero
                value = load(kind, path)
            outcome = "accepted"
        except PerchError as error:
            value, outcome = None, "refused"
            if len(str(error).splitlines()) != 1 or len(str(error)) > LONGEST_LINE or not str(error).isprintable():
                raise Nonsense(f"not one line: {error!r}") from None
        except Exception:
            raise Nonsense(traceback.format_exc()) from None
    if time.process_time() - began > SLOW:
        raise Nonsense(f"{outcome} after {time.process_time() - began:.1f} s")
    for problem in senseless(value):
        raise Nonsense(problem)
    return outcome


def senseless(value: Any, place: str = "") -> Iterator[str]:
    """What is wrong with a value that was accepted: its declarations, and facts that hold for every value of its class."""
    if isinstance(value, np.ndarray):
        if not np.isfinite(value).all():
            yield f"{place}: not finite"
    elif isinstance(value, (tuple, list)):
        for entry in value:
            yield from senseless(entry, place)
    elif isinstance(value, dict):
        for name, entry in value.items():
            yield from senseless(entry, f"{place}.{name}")
    elif dataclasses.is_dataclass(value):
        for item in dataclasses.fields(value):
            entry = getattr(value, item.name)
            yield from _outside(item, entry, f"{place}.{item.name}")
            yield from senseless(entry, f"{place}.{item.name}")
        for fact, holds in FACTS.get(type(value), {}).items():
            if not holds(value):
                yield f"{place}: {fact} does not hold"


def _outside(item: dataclasses.Field, entry: Any, place: str) -> Iterator[str]:
    """Numbers of a field that are outside its range."""
    meta = item.metadata
    low, high, above = (meta[key] if meta.get(key) is not None else none for key, none in (("low", -math.inf), ("high", math.inf), ("above", -math.inf)))
    for number in _numbers(entry):
        if number != item.default and not (math.isfinite(number) and low <= number <= high and number > above):
            yield f"{place}: {number} is outside its range"


def _numbers(entry: Any) -> Iterator[float]:
    if isinstance(entry, (tuple, list)):
        for part in entry:
            yield from _numbers(part)
    elif isinstance(entry, (int, float)) and not isinstance(entry, bool):
        yield entry


FACTS: dict[type, dict[str, Callable[[Any], bool]]] = {
    Vehicle: {
        "it can fly and land": lambda v: 4 * v.thrust_min < 9.81 * v.mass < 4 * v.thrust_max <= 4000.0,
        "each rotor turns one way": lambda v: set(map(abs, v.rotor_yaw_sign)) == {1},
        "all axes can be turned about": lambda v: np.linalg.matrix_rank(v.allocation, tol=1e-9) == 4,
        "a body has this inertia": lambda v: 2 * max(v.inertia) <= 1.002 * sum(v.inertia) and max(v.inertia) <= v.mass * max(v.body_radii) ** 2,
        "its name is one of a file": lambda v: "/" not in v.name and not v.name.startswith("."),
    },
    Scenario: {
        "a powerline has cables": lambda s: s.mode != "powerline" or len(s.world.cables) > 0,
        "its name is one of a file": lambda s: "/" not in s.name and not s.name.startswith("."),
        "it ends": lambda s: 0.0 < s.time_limit <= 600.0,
    },
    TagBoard: {"tags are on the pad": lambda b: bool((np.abs(b.corners_S[..., :2]) <= np.array(b.pad_size) / 2 + 1e-6).all())},
    Campaign: {
        "it ends": lambda c: 0 < len(c.runs) <= RUNS_MAX,
        "flights have seeds": lambda c: all(0 <= run.seed < 2**31 for run in c.runs),
        "its name is one of a file": lambda c: "/" not in c.name and not c.name.startswith("."),
    },
}

NASTY = (0, -1, 1, 1e308, -1e308, 1e-320, -0.0, 1e9, math.nan, math.inf, -math.inf, 2**31, 2**63, 2**64, 10**400, "", "abc", "nan", "1.0", "../../x",
         "/dev/zero", "x.yaml", "a" * 300, "\x00", "\u202e", "\n", None, True, False, [], {}, [[]], [{}], {"a": 1}, [1.0, 2.0],
         [math.nan] * 3, [0.0] * 3, ["a"] * 3, [1e200] * 4)
TOKENS = (b"[", b"{", b"]", b"}", b"[" * 3000, b"{a: " * 3000, b"- " * 500, b": ", b"? ", b"&a ", b"*a", b"<<: ", b"!!python/object:os.system ",
          b"!!float ", b"!!set ",
          b"%YAML 9.9\n", b"---\n", b"...\n", b"|\n", b">\n", b"\t", b"\x00", b"\xff", b"\xef\xbb\xbf", b"'", b'"', b"\\",
          b"#", b"1" * 5000, b"1e999", b".nan", b"-.inf", b"0x1",
          b"2024-99-99", b"1:30", b"=", b"~", b"@", b"`", b"\r", b"\xe2\x80\xa8", b"&x [*x, *x]\n")


def mutated(content: bytes, rng: random.Random) -> bytes:
    """The content of a file after some changes."""
    for _ in range(rng.choice((1, 1, 1, 2, 3, 8))):
        content = (_restructured if rng.random() < 0.6 else _rewritten)(content, rng)
    return content


def _rewritten(content: bytes, rng: random.Random) -> bytes:
    """Bytes or lines changed."""
    at, lines = rng.randrange(len(content) + 1), content.splitlines(keepends=True)
    line = rng.randrange(len(lines)) if lines else 0
    return rng.choice((
        lambda: content[:at] + bytes([rng.randrange(256)]) + content[at + 1:],
        lambda: content[:at] + rng.choice(TOKENS) + content[at:],
        lambda: content[:at] + content[at + rng.choice((1, 1, 2, 10)):],
        lambda: content[:at],
        lambda: b"".join(lines[:line] + lines[line:line + 1] * rng.choice((2, 2, 3, 3000)) + lines[line + 1:]),
        lambda: b"".join(lines[:line] + lines[line + 1:]),
        lambda: b"".join(lines[:line] + [b" " * rng.randrange(5) + text.lstrip() for text in lines[line:line + 1]] + lines[line + 1:]),
        lambda: b"".join(rng.sample(lines, len(lines))),
    ))()


def _restructured(content: bytes, rng: random.Random) -> bytes:
    """One value, key or entry changed; what is no YAML any more stays as it is."""
    try:
        tree = [config.parse_yaml(content.decode(), "")]
    except (PerchError, ValueError):
        return content
    places = list(_places(tree))
    holder, key = rng.choice(places)
    value = holder[key]
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    changes: list[Callable[[], Any]] = [lambda: rng.choice(NASTY), lambda: [value], lambda: {"a": value}]
    if number:
        changes += [lambda: value * 10.0 ** rng.randint(-12, 12), lambda: -value, lambda: value + rng.gauss(0.0, 1.0), lambda: str(value)] * 2
    if isinstance(value, list):
        changes += [lambda: value * rng.choice((0, 2, 30, 900)), lambda: value[:-1], lambda: value[::-1]]
    if isinstance(holder, dict):
        changes += [lambda: KeyError, lambda: (rng.choice((f"{key}x", f"{key}.{key}", "../x", "", "seed.0", "parameters.vio.a")), value)]
    changed = rng.choice(changes)()
    if changed is KeyError:
        del holder[key]
    elif isinstance(changed, tuple):
        holder[changed[0]] = holder.pop(key)
    else:
        holder[key] = changed
    return yaml.dump(tree[0], Dumper=_Dumper, allow_unicode=True, sort_keys=False).encode(errors="surrogatepass")


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _places(holder: Any) -> Iterator[tuple[Any, Any]]:
    for key in list(holder) if isinstance(holder, dict) else range(len(holder)):
        yield holder, key
        if isinstance(holder[key], (dict, list)):
            yield from _places(holder[key])


def run(minutes: float, seed: int, report: Report) -> None:
    """Hunt, in a process that may crash or hang."""
    rng, files = random.Random(seed), kinds()
    runner = IsolatedRunner(preload=kinds)
    try:
        while not runner.wait_ready():
            pass
        report.begin()
        while report.going():
            kind = rng.choice(list(files))
            file = rng.choice(files[kind])
            content = mutated(file.read_bytes(), rng)
            try:
                report.tried(runner.submit(Job(judge, (kind, content), then=id, limit=HUNG)).result(2 * HUNG))
            except (Nonsense, JobFailed, JobStopped, TimeoutError) as error:
                if "not begun" not in str(error):
                    report.found(f"{kind}{file.suffix}", content, f"{kind}: {error!s:.5000}")
    finally:
        runner.close()
