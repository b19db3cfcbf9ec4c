"""Stamps of the inputs of completed set-up steps, by which a later start quickly detects that nothing is to do."""

from __future__ import annotations

import hashlib
import json
import os
import re
from pathlib import Path
from typing import Iterable

from .layout import EXTRAS, ROOT, SOURCES, STATE
from .machine import Platform, provides

_FILE = STATE / "stamps.json"
_IMPORT = re.compile(r"^from (perch_[\w.]+) import (\([^)]*\)|.*)", re.MULTILINE)
_CONSTANT = re.compile(r"\b[A-Z_]{2,}\b")
_BUILD_FILES = ("package.xml", "setup.py", "setup.cfg", "CMakeLists.txt")


def environment_stamp(target: Platform) -> str:
    """Return a stamp that changes whenever the virtual environment has to be installed again.

    The Python that runs this is not part of it, as an environment keeps the one it was made with.
    """
    repairs = (Path(__file__).with_name(name) for name in ("wheel_paths.py", "slim.py"))
    return _digest((*target.locks, *repairs), target.ros, str(ROOT))


def extra_stamp(extra: str, environment: str) -> str:
    """Return a stamp that changes whenever the packages of an extra have to be installed again."""
    return _digest((EXTRAS[extra],), environment)


def package_stamp(package: Path, environment: str) -> str:
    """Return a stamp that changes whenever colcon has to build a package again.

    Python modules are not part of it: they are linked into the workspace, so edits are live. Of
    configuration files, which are linked as well, only the names count.
    """
    interfaces = (file for kind in ("msg", "srv", "action") for file in sorted((package / kind).glob("*")))
    files = [*(package / name for name in _BUILD_FILES), *interfaces]
    linked = sorted(str(file) for file in (package / "config").glob("**/*.yaml"))
    return _digest((file for file in files if file.exists()), environment, *linked)


def kernel_stamp(environment: str) -> str:
    """Return a stamp that changes with every file that holds compiled kernels, or constants that are imported for them."""
    files = {file for file in SOURCES.rglob("*.py") if file.is_file() and b"@compiled" in file.read_bytes()}  # an editor's lock is no file
    pending = list(files)
    while pending:
        for module, names in _IMPORT.findall(pending.pop().read_text()):
            file = SOURCES.joinpath(module.split(".")[0], *module.split(".")).with_suffix(".py")
            if _CONSTANT.search(names) and file not in files and file.exists():
                files.add(file)
                pending.append(file)
    return _digest(sorted(files), environment)


def packages(target: Platform) -> list[Path]:
    """Return the folders of all packages to build; those of ROS itself only if the installation lacks them.

    With our wheels, sourced packages are ignored, as they may be those of another checkout of perch.
    """
    return sorted(file.parent for file in SOURCES.glob("*/package.xml")
                  if target.uses_wheels or file.parent.name.startswith("perch_") or not provides(file.parent.name))


def load() -> dict[str, str]:
    """Return the stamps of all completed steps; empty if there are none or the file is damaged."""
    try:
        stamps = json.loads(_FILE.read_text())
    except (OSError, ValueError, RecursionError):
        return {}
    return stamps if isinstance(stamps, dict) else {}


def save(stamps: dict[str, str]) -> None:
    """Replace all stamps atomically: no reader gets half a file."""
    STATE.mkdir(exist_ok=True)
    draft = _FILE.with_suffix(f".{os.getpid()}")
    draft.write_text(json.dumps(stamps, indent=1))
    draft.replace(_FILE)


def _digest(files: Iterable[Path], *texts: str) -> str:
    """SHA-256 over texts, and over names and contents of files."""
    digest = hashlib.sha256("\0".join(texts).encode())
    for file in files:
        digest.update(f"\0{file.relative_to(ROOT)}\0".encode())
        digest.update(file.read_bytes())
    return digest.hexdigest()
