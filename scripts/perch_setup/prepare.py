"""Brings virtual environment and workspace up to date, doing only what is missing."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
from collections.abc import Collection, Iterator
from pathlib import Path

from . import stamps, virtualenv, workspace
from .environment import variables
from .errors import USAGE_ERROR, SetupError
from .layout import EXTRAS, INSTALL, ROOT, SOURCES, VENV_PYTHON
from .lock import descriptors, setup_lock
from .machine import Platform, check_python, check_tools, detect_platform, record_installation
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
    target = detect_platform()
    if not clean and _nothing_to_do(target, stamps.load(), extras):
        return target
    check_tools()
    with setup_lock():
        done = {} if clean else stamps.load()
        if _nothing_to_do(target, done, extras):
            return target
        _install(target, done, clean)
        _install_extras(target, done, extras)
        with _compiled(target, done):
            _build(target, done)
    return target


def _install(target: Platform, done: dict[str, str], clean: bool = False) -> None:
    """Install the locked packages, unless they are up to date; `clean`: in an empty environment."""
    environment = stamps.environment_stamp(target)
    if done.get("environment") == environment and virtualenv.usable():
        return
    identity = f"{target.ros} in {ROOT}"
    earlier = done.get("identity", identity)
    fresh = clean or earlier != identity or not virtualenv.usable()
    if fresh:
        check_python(target)
    if earlier != identity:
        print(f"perch set-up: this checkout was set up with ROS from {earlier}, and is now with ROS from {identity}: paths are written into "
              "the virtual environment and the build, so both are made anew. Packages come from pip's cache where they are in it.",
              file=sys.stderr)
    done.pop("environment", None)
    for extra in EXTRAS if fresh else ():
        done.pop(f"extra {extra}", None)
    stamps.save(done)
    virtualenv.install(target, fresh)
    record_installation(target)
    done.update(environment=environment, identity=identity)
    stamps.save(done)


def _install_extras(target: Platform, done: dict[str, str], extras: Collection[str]) -> None:
    """Install the locked packages of extras, unless they are up to date."""
    for extra in extras:
        stamp = stamps.extra_stamp(extra, done["environment"])
        if done.get(f"extra {extra}") == stamp:
            continue
        try:
            virtualenv.install_extra(target, extra)
        except SetupError as error:
            raise SetupError(f"this needs the extra packages {extra!r}, which cannot be installed now. With network, "
                             f"'python3 scripts/setup.py --extra {extra}' does it.\n{error}", USAGE_ERROR) from None
        done[f"extra {extra}"] = stamp
        stamps.save(done)


def _build(target: Platform, done: dict[str, str]) -> None:
    """Build the packages that changed, or all of them in a new environment."""
    environment = done["environment"]
    fresh = done.get("built_with") != environment
    current = {folder: stamps.package_stamp(folder, environment) for folder in stamps.packages(target)}
    stale = [folder for folder in current if not _is_built(folder, current[folder], done)]
    if stale:
        for folder in stale:
            done.pop(folder.name, None)
        stamps.save(done)
        workspace.build(stale, target, fresh)
        done.update({folder.name: current[folder] for folder in stale}, built_with=environment)
        stamps.save(done)


@contextlib.contextmanager
def _compiled(target: Platform, done: dict[str, str]) -> Iterator[None]:
    """Compile the numerics into their caches if their sources have changed: those of a flight without ROS in parallel with the
    build, which leaves cores idle, and after it those that only nodes call.

    A failure is only reported, as kernels that are not cached are compiled when a node first needs them.
    """
    stamp = stamps.kernel_stamp(done["environment"])
    if done.get("warmed") == stamp:
        yield
        return
    command = (VENV_PYTHON, "-m", WARM_UP)
    environment = variables(target, with_workspace=False)
    environment["PYTHONPATH"] = os.pathsep.join([*map(str, SOURCES.glob("perch_*")), environment.get("PYTHONPATH", "")])
    with subprocess.Popen([*command, "flight"], env=environment, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                          stderr=subprocess.DEVNULL, pass_fds=descriptors()) as flight:
        try:
            yield
            try:
                with Step("compiling the numerics of a flight") as step:
                    code = flight.wait()
                    step.run((*command, "nodes"), "warm_up", variables(target))
                if code:
                    raise SetupError(f"{WARM_UP} flight: exit code {code}")
            except SetupError as error:
                print(f"perch set-up: compiling is left to the first flight ({error})", file=sys.stderr)
        finally:
            flight.kill()
    done["warmed"] = stamp
    stamps.save(done)


def _nothing_to_do(target: Platform, done: dict[str, str], extras: Collection[str]) -> bool:
    """Whether every stamp is up to date and the folders are still there."""
    environment = stamps.environment_stamp(target)
    if done.get("environment") != environment or not virtualenv.usable() or done.get("warmed") != stamps.kernel_stamp(environment):
        return False
    if any(done.get(f"extra {extra}") != stamps.extra_stamp(extra, environment) for extra in extras):
        return False
    return (INSTALL / "setup.bash").exists() and all(
        _is_built(folder, stamps.package_stamp(folder, environment), done) for folder in stamps.packages(target))


def _is_built(folder: Path, stamp: str, done: dict[str, str]) -> bool:
    return done.get(folder.name) == stamp and (INSTALL / folder.name).exists()
