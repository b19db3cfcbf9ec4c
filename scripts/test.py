#!/usr/bin/env python3
"""Run all tests of perch. Sets everything up on first use.

Everything that is not an option of this script goes to pytest.
"""

from __future__ import annotations

import atexit
import gc
import os
import signal
import sys
import tempfile
from typing import IO, NoReturn

from perch_setup import EXTRAS, ROOT, command_parser, enter, leave_quietly_on_interrupt, quiet_on_interrupt
from perch_setup.enter import INTERRUPTED

PARTS = (
    ("tests/system/test_restart.py", "tests/unit/test_autopilot_firmware.py", "tests/system/test_scripts_graph.py", "tests/unit/test_autopilot_links.py",
     "tests/unit/test_autopilot_start.py", "tests/unit/test_eval_mission_client.py"),
    ("tests/system/test_flight_surface.py",), ("tests/system/test_two_vehicles.py", "tests/unit/test_goals_in_a_row.py"),
    ("tests/recordings/",), ("tests/nodes/",), ("tests/system/test_bad_input.py",), ("tests/system/test_campaign.py",),
    ("tests/fuzz/test_messages.py", "tests/fuzz/test_services.py"), ("tests/unit/test_types.py",), ("tests/unit/test_vio_component.py",),
    ("tests/unit/test_vio_filter.py",), ("tests/unit/test_vio_images.py",), ("tests/unit/test_vio_rest.py",), ("tests/unit/test_control_nmpc.py",),
    ("tests/unit/test_eval_replay.py", "tests/unit/test_eval_compare.py"),
)
"""The longest parts, which start first; each other file is a part.

Files and folders of one part share expensive fixtures or, where they wait for clocks and processes, leave the cores to the other processes:
two that wait at once would leave one idle. At the end of a part all fixtures end.
"""
PROCESSES = 1 + min(os.cpu_count() or 1, 5)
"""One more than cores (at most 6), as some tests wait for clocks or processes; with two more, real-time tests starve."""
PYCACHE = ROOT / ".perch" / "pycache"

EXAMPLES = """examples:
  python3 scripts/test.py                        all tests
  python3 scripts/test.py --quick                unit tests that fly, draw and start nothing (`pytest -m quick`)
  python3 scripts/test.py --fast                 without tests/system, which fly whole stacks
  python3 scripts/test.py tests/unit -k camera   some tests
  python3 scripts/test.py -x --lf                any option of pytest

exit code: 0 all passed, 1 some failed, 2 wrong arguments, 130 Ctrl-C"""


def main() -> int:
    """Run pytest; return the exit code."""
    parser = command_parser(__doc__, EXAMPLES, allow_abbrev=False)
    parser.add_argument("--quick", action="store_true", help="only the unit tests that fly, draw and start nothing")
    parser.add_argument("--fast", action="store_true", help="skip tests/system")
    arguments, for_pytest = parser.parse_known_args()
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)  # as in tests/conftest.py, for the reason given there
    os.environ.setdefault("PYTHONPYCACHEPREFIX", str(PYCACHE))
    enter(*EXTRAS)
    return run_tests(arguments.quick, arguments.fast, for_pytest)


def run_tests(quick: bool, fast: bool, for_pytest: list[str]) -> int:
    """Run pytest with a reserved ROS domain, in this process or, where none are named, in several that share them."""
    with quiet_on_interrupt():
        import pytest  # noqa: F401
        from perch_eval.domain import free_domain

    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    # Before the first message class is imported: rclpy does not check fields by default.
    os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
    os.chdir(ROOT)
    chosen = ["-m", "quick", *["tests/unit"] * (not for_pytest)] if quick else ["--ignore=tests/system"] if fast else []
    processes = PROCESSES - 1 if quick else PROCESSES  # quick tests wait for nothing
    if not for_pytest and PROCESSES > 2:
        print(f"{processes} processes share the tests; what the others print comes at the end", flush=True)
        workers = WorkerPlugin(parts(test_files()), processes)
        workers.end(run_pytest([*chosen, "-o", "console_output_style=classic"], workers, *() if quick else (ForkServerPlugin(),)))
    return run_pytest([*chosen, *for_pytest])


def run_pytest(arguments: list[str], *plugins: object) -> int:
    """Run pytest in this process; return the exit code that the help names."""
    import pytest

    interrupts = InterruptPlugin()
    code = pytest.main(arguments, [*plugins, interrupts])
    return INTERRUPTED if interrupts.seen else {0: 0, 1: 1}.get(int(code), 2 if code == pytest.ExitCode.USAGE_ERROR else 1)


class InterruptPlugin:
    """Pytest plugin that notes Ctrl-C; pytest's own exit code is the same where files could not be collected."""

    seen = False

    def pytest_keyboard_interrupt(self, excinfo) -> None:
        """Pytest's own interrupts are of a derived class."""
        self.seen = excinfo.type is KeyboardInterrupt


class ForkServerPlugin:
    """Pytest plugin that starts the fork servers of scripts and nodes while tests are collected, when a core is idle."""

    def pytest_sessionstart(self) -> None:
        """Start the fork servers, which all test processes share."""
        from system.forks import NODES, SCRIPTS, forks

        forks(NODES), forks(SCRIPTS)


class WorkerPlugin:
    """Pytest plugin that forks processes after the collection of tests; each takes the next part when it has finished one."""

    def __init__(self, parts: list[tuple[str, ...]], processes: int) -> None:
        self._parts, self._processes = parts, processes
        self._left, numbers = os.pipe()  # of the parts that are not yet taken
        os.write(numbers, b"".join(number.to_bytes(2, "big") for number in range(len(parts))))
        os.close(numbers)
        self._others: list[tuple[int, IO[str]]] = []  # process ids, and what they print
        self._forked = False

    def next_part(self) -> tuple[str, ...] | None:
        """Files and folders of the next part; None where all are taken."""
        number = os.read(self._left, 2)
        return self._parts[int.from_bytes(number, "big")] if number else None

    def pytest_collection(self) -> None:
        """Nearly all that is made in the collection stays: the garbage collector would traverse it in vain."""
        gc.disable()

    def pytest_runtestloop(self, session) -> bool:
        """Fork the other processes and run parts of the tests, in place of pytest's own loop."""
        if session.testsfailed:
            raise session.Interrupted(f"{session.testsfailed} files could not be collected")
        sys.stdout.flush()
        gc.freeze()  # memory that the collector does not traverse is not copied
        gc.enable()
        while len(self._others) < self._processes - 1:
            output = tempfile.TemporaryFile("w+", errors="replace")
            if (pid := os.fork()) == 0:
                set_up_worker(session.config, output)
                self._others, self._forked = [], True
                break
            self._others.append((pid, output))
        found: dict[str, list] = {}  # tests by file
        for item in session.items:
            found.setdefault(item.nodeid.split("::")[0], []).append(item)
        while (part := self.next_part()) is not None:
            items = [item for file, some in found.items() if any(within(name, file) for name in part) for item in some]
            for item, following in zip(items, [*items[1:], None]):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if session.shouldstop:
                    raise session.Interrupted(session.shouldstop)
        return True

    def end(self, code: int) -> NoReturn:
        """End this process: a forked one with its own code, the first one, after printing the others' output, with that of all.

        The C library's exit is avoided, as threads of Fast DDS that tests have left crash in it.
        """
        leave_quietly_on_interrupt()
        for pid, output in self._others:
            with output:
                ended = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                output.seek(0)
                print(output.read(), flush=True)
            if ended:
                code = max(code, 1)
                print(f"the process of these tests ended with {f'signal {-ended}' if ended < 0 else f'exit code {ended}'}", flush=True)
        if not self._forked:
            atexit._run_exitfuncs()
        sys.stdout.flush(), sys.stderr.flush()
        os._exit(code)


def set_up_worker(config, output: IO[str]) -> None:
    """Set up a forked test process: own ROS domain and output; pytest's cache is written by the first process only."""
    from perch_core.processes import end_with_parent
    from perch_eval.domain import free_domain

    end_with_parent(signal.SIGKILL)
    os.environ["ROS_DOMAIN_ID"] = str(free_domain())
    capture = config.pluginmanager.getplugin("capturemanager")
    capture.stop_global_capturing()
    for number in (1, 2):
        os.dup2(output.fileno(), number)
    capture.start_global_capturing(), capture.suspend_global_capture()
    for name in ("lfplugin", "nfplugin"):
        config.pluginmanager.unregister(name=name)


def within(name: str, file: str) -> bool:
    """Return whether a file is the named one, or lies in the named folder."""
    return file == name or name.endswith("/") and file.startswith(name)


def test_files() -> list[str]:
    """Return all test files, relative to the repository."""
    return sorted(path.relative_to(ROOT).as_posix() for path in (ROOT / "tests").rglob("test_*.py"))


def parts(files: list[str]) -> list[tuple[str, ...]]:
    """Return `PARTS` as far as their files exist, then each other file, those of tests/system first."""
    found = [tuple(name for name in part if any(within(name, file) for file in files)) for part in PARTS]
    named = [name for part in PARTS for name in part]
    others = [(file,) for file in files if not any(within(name, file) for name in named)]
    return [part for part in found if part] + sorted(others, key=lambda part: not part[0].startswith("tests/system/"))


if __name__ == "__main__":
    sys.exit(main())
