"""Brings virtual environment and workspace up to date, doing only what is missing."""

from __future__ import annotations

import contextlib
import os
import shutil
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

from . import stamps, virtualenv, workspace
from .alone import alone, held
from .environment import variables
from .errors import CALLERS_MISTAKE, SetupError
from .layout import BUILD, EXTRAS, INSTALL, ROOT, SOURCES, VENV, VENV_PYTHON
from .machine import Platform, check_python, check_tools, detect_platform, remember
from .progress import Step

WARM_UP = "perch_eval.warm_up"


def prepare(clean: bool = False, extras: Collection[str] = ()) -> Platform:
    """Set up what is missing; fast if there is nothing to do, and safe to interrupt and repeat.

    Args:
        clean: start from nothing.
        extras: packages in addition to those of a flight, names in `requirements/extras`.

    Returns:
        Where ROS comes from.

    Raises:
        SetupError: the machine lacks something, or a step fails.
    """
    wanted = detect_platform()
    if not clean and _nothing_to_do(wanted, stamps.load(), extras):
        return wanted
    check_tools()
    with alone():
        done = {} if clean else stamps.load()
        if _nothing_to_do(wanted, done, extras):
            return wanted
        if clean:
            for folder in (VENV, BUILD, INSTALL):
                shutil.rmtree(folder, ignore_errors=True)
        _install(wanted, done)
        _install_extras(wanted, done, extras)
        with _compiled(wanted, done):
            _build(wanted, done)
    return wanted


def _install(wanted: Platform, done: dict[str, str]) -> None:
    """Install the locked packages, unless they are up to date."""
    environment = stamps.environment_stamp(wanted)
    if done.get("environment") == environment and virtualenv.usable():
        return
    identity = f"{wanted.ros} in {ROOT}"
    earlier = done.get("identity", identity)
    fresh = earlier != identity or not virtualenv.usable()
    if fresh:
        check_python(wanted)
    if earlier != identity:
        print(f"perch set-up: this checkout was set up with ROS from {earlier}, and is now with ROS from {identity}: paths are written into "
              "the virtual environment and the build, so both are made anew. Packages come from pip's cache where they are in it.",
              file=sys.stderr)
    done.pop("environment", None)
    for extra in EXTRAS if fresh else ():
        done.pop(f"extra {extra}", None)
    stamps.save(done)
    virtualenv.install(wanted, fresh)
    remember(wanted)
    done.update(environment=environment, identity=identity)
    stamps.save(done)


def _install_extras(wanted: Platform, done: dict[str, str], extras: Collection[str]) -> None:
    """Install the locked packages of extras, unless they are up to date."""
    for extra in extras:
        stamp = stamps.extra_stamp(extra, done["environment"])
        if done.get(f"extra {extra}") == stamp:
            continue
        try:
            virtualenv.install_extra(wanted, extra)
        except SetupError as error:
            raise SetupError(f"this needs the extra packages {extra!r}, which cannot be installed now. With network, "
                             f"'python3 scripts/setup.py --extra {extra}' does it.\n{error}", CALLERS_MISTAKE) from None
        done[f"extra {extra}"] = stamp
        stamps.save(done)


def _build(wanted: Platform, done: dict[str, str]) -> None:
    """Build the packages that changed, or all of them in a new environment."""
    environment = done["environment"]
    fresh = done.get("built_with", environment) != environment
    current = {folder: stamps.package_stamp(folder, environment) for folder in stamps.packages(wanted)}
    stale = [folder for folder in current if not _is_built(folder, current[folder], done)]
    if stale:
        for folder in stale:
            done.pop(folder.name, None)
        stamps.save(done)
        workspace.build(stale, wanted, fresh)
        done.update({folder.name: current[folder] for folder in stale}, built_with=environment)
        stamps.save(done)


@contextlib.contextmanager
def _compiled(wanted: Platform, done: dict[str, str]) -> Iterator[None]:
    """Compile the numerics into their caches if their sources have changed: those of a flight without ROS in parallel with the
    build, which leaves cores idle, and after it those that only nodes call.

    A failure is only reported, as kernels that are not cached are compiled when a node first needs them.
    """
    stamp = stamps.kernel_stamp(done["environment"])
    if done.get("warmed") == stamp:
        yield
        return
    command = (VENV_PYTHON, "-m", WARM_UP)
    environment = variables(wanted, with_workspace=False)
    environment["PYTHONPATH"] = os.pathsep.join([*map(str, SOURCES.glob("perch_*")), environment.get("PYTHONPATH", "")])
    with subprocess.Popen([*command, "flight"], env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL, pass_fds=held()) as flight:
        try:
            yield
            with Step("compiling the numerics of a flight") as step:
                flight.wait()
                try:
                    step.run((*command, "nodes"), "warm_up", variables(wanted))
                except SetupError as error:
                    print(f"perch set-up: left to the first flight ({error})", file=sys.stderr)
        finally:
            flight.kill()
    done["warmed"] = stamp
    stamps.save(done)


def _nothing_to_do(wanted: Platform, done: dict[str, str], extras: Collection[str]) -> bool:
    """Whether every stamp is up to date and the folders are still there."""
    environment = stamps.environment_stamp(wanted)
    if done.get("environment") != environment or not virtualenv.usable() or done.get("warmed") != stamps.kernel_stamp(environment):
        return False
    if any(done.get(f"extra {extra}") != stamps.extra_stamp(extra, environment) for extra in extras):
        return False
    return (INSTALL / "setup.bash").exists() and all(
        _is_built(folder, stamps.package_stamp(folder, environment), done) for folder in stamps.packages(wanted))


def _is_built(folder: Path, stamp: str, done: dict[str, str]) -> bool:
    return done.get(folder.name) == stamp and (INSTALL / folder.name).exists()
