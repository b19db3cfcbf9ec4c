"""The arrows between the packages, read from their imports. See docs/architecture.md."""

import ast
import subprocess
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
MIDDLE = {"perch_planner", "perch_control", "perch_perception", "perch_sim", "perch_autopilot"}
ALLOWED = {"perch_core": {"perch_core"}, "perch_eval": MIDDLE | {"perch_core", "perch_eval"}} | {
    name: {"perch_core", name} for name in MIDDLE}
ROS = ("rclpy", "rcl_interfaces", "builtin_interfaces", "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "std_srvs",
       "diagnostic_msgs", "visualization_msgs", "rosgraph_msgs", "perch_msgs", "tf2_msgs")
SOURCES = sorted(p for package in ALLOWED for p in (ROOT / "src" / package / package).rglob("*.py"))


def imports(path: Path) -> set[str]:
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            names.add(node.module)
    return names


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_imports_follow_the_arrows(path):
    package = path.relative_to(ROOT / "src").parts[0]
    for name in imports(path):
        first = name.split(".")[0]
        if first.startswith("perch_") and first != "perch_msgs":
            assert first in ALLOWED[package], f"{path}: imports {name}"
        if first in ROS:
            assert path.name.endswith("_node.py") or "ros" in path.relative_to(ROOT / "src" / package).parts, \
                f"{path}: imports {name}; ROS belongs in *_node.py and folders ros/"


TABLE = Path("perch_core", "ros", "topics.py")  # names every channel


@pytest.mark.parametrize("path", [p for p in SOURCES if not {"perch_sim", "perch_eval"} & set(p.parts) and p.parts[-3:] != TABLE.parts],
                         ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_only_simulator_and_evaluation_know_the_truth(path):
    assert "ground_truth" not in path.read_text()


OUTSIDE = [p for p in SOURCES if not {"perch_sim", "perch_eval"} & set(p.parts)]
HOST = {Path("perch_core", *parts) for parts in (("component.py",), ("ros", "node.py"), ("ros", "wiring.py"), ("ros", "parameters.py"))}
"""What may mention the lockstep outside the simulator: the list of hosts, the place that chooses one, and what neighbours share with one."""


@pytest.mark.parametrize("path", OUTSIDE, ids=lambda p: str(p.relative_to(ROOT / "src")))
def test_the_simulator_alone_knows_of_its_lockstep(path):
    if path.relative_to(ROOT / "src" / path.relative_to(ROOT / "src").parts[0]) not in HOST:
        assert "lockstep" not in path.read_text().lower()


def test_the_lockstep_has_no_messages():
    """Its batches are the simulator's own business: nothing of them is on the graph, where others could write, too."""
    assert not [file.name for file in (ROOT / "src" / "perch_msgs").rglob("*.msg") if "step" in file.name.lower() or "packet" in file.name.lower()]


def test_every_source_is_seen():
    tracked = subprocess.run(["git", "ls-files", "src/*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    missing = {ROOT / line for line in tracked.split() if not line.endswith("setup.py")} - set(SOURCES)
    assert {p for p in missing if p.exists() and "perch_msgs" not in p.parts} == set()
