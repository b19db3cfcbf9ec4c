"""Repair of the ROS wheels, whose CMake exports have paths of the machine that built them."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

_EXPORTS = "share/**/*rosidl_generator_pyExport.cmake"
_NUMPY = re.compile(r"/opt/python/[^;\"]*/numpy/_core/include")
_PYTHON = re.compile(r"/opt/python/[^;\"]*/include/python3\.\d+")


def repair(text: str, python_include: str, numpy_include: str) -> str:
    """Replace the build machine's include folders in one CMake export."""
    text = _NUMPY.sub(lambda _: numpy_include, text)
    return _PYTHON.sub(lambda _: python_include, text)


def repair_wheels(prefix: Path) -> int:
    """Repair every export below a virtual environment. Idempotent.

    Returns:
        The number of files that were changed.
    """
    code = "import sysconfig, numpy; print(sysconfig.get_paths()['include']); print(numpy.get_include())"
    answer = subprocess.run(
        [prefix / "bin" / "python", "-c", code], check=True, capture_output=True, text=True
    )
    python_include, numpy_include = answer.stdout.split("\n")[:2]
    changed = 0
    for export in sorted(prefix.glob(_EXPORTS)):
        before = export.read_text()
        after = repair(before, python_include, numpy_include)
        if after != before:
            export.write_text(after)
            changed += 1
    return changed
