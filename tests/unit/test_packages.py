"""Each package.xml names what the package imports, and `colcon test` finds the package's tests."""

from __future__ import annotations

import ast
import configparser
import re
import sys
import xml.etree.ElementTree as xml
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = sorted(folder.parent.name for folder in (ROOT / "src").glob("*/setup.py"))
KEYS = {"PIL": "python3-pil", "casadi": "casadi-pip", "cv2": "python3-opencv", "filterpy": "python3-filterpy-pip",
        "matplotlib": "python3-matplotlib", "nlopt": "python3-nlopt", "numba": "python3-numba", "numpy": "python3-numpy",
        "psutil": "python3-psutil", "pymavlink": "python3-pymavlink-pip", "rosbags": "python3-rosbags-pip",
        "scipy": "python3-scipy", "yaml": "python3-yaml"}
"""Module -> key of rosdep (ros/rosdistro, rosdep/python.yaml)."""
WITHOUT_KEY = {"daqp": "daqp", "distributed": "distributed", "evo": "evo", "foxglove": "foxglove-sdk", "mcap": "mcap", "osqp": "osqp",
               "zstandard": "zstandard"}
"""Module -> package on PyPI that rosdep does not know."""


def imported(package: str) -> set[str]:
    """First names of all modules that a package imports, without Python's own and its own."""
    names: set[str] = set()
    for file in (ROOT / "src" / package / package).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                names.add(str(node.module).split(".")[0])
    return names - {package, "_typeshed", *sys.stdlib_module_names}  # _typeshed exists for type checkers only


def selected(package: str) -> dict[str, list[Path]]:
    """Pattern in the package's pytest.ini -> files that match."""
    folder = ROOT / "src" / package
    ini = configparser.ConfigParser()
    ini.read(folder / "pytest.ini")
    return {pattern: sorted(file.resolve() for file in folder.glob(pattern)) for pattern in ini["pytest"]["testpaths"].split()}


@pytest.mark.parametrize("package", PACKAGES)
def test_package_xml_names_exactly_what_is_imported(package):
    text = (ROOT / "src" / package / "package.xml").read_text()
    named = [str(tag.text) for tag in xml.fromstring(text).iter("exec_depend")]
    modules = imported(package)
    assert sorted(named) == sorted(KEYS.get(name, name) for name in modules if name not in WITHOUT_KEY)
    by_pip = re.search(r"<!-- Without a rosdep key, from requirements/python.in: (.*) -->", text)
    assert (by_pip[1].split(", ") if by_pip else []) == sorted(WITHOUT_KEY[name] for name in modules if name in WITHOUT_KEY)


@pytest.mark.parametrize("package", PACKAGES)
def test_colcon_finds_tests_of_the_package(package):
    """`colcon test` runs pytest in the package's folder, where its pytest.ini counts."""
    found = selected(package)
    assert found and all(found.values()), {pattern: len(files) for pattern, files in found.items()}
    for file in {file for files in found.values() for file in files}:
        assert re.search(rf"\b{package}\b", file.read_text()), f"{file.name} does not import {package}"


def test_no_test_is_of_two_packages():
    files = [file for package in PACKAGES for file in {file for files in selected(package).values() for file in files}]
    assert len(files) == len(set(files))
