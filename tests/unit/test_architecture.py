"""The arrows between the packages, read from their imports. See docs/architecture.md."""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
MIDDLE = {"perch_planner", "perch_control", "perch_perception", "perch_sim", "perch_autopilot"}
ALLOWED = {"perch_core": {"perch_core"}, "perch_eval": MIDDLE | {"perch_core", "perch_eval"}} | {
    name: {"perch_core", name} for name in MIDDLE}
ROS = ("rclpy", "rcl_interfaces", "builtin_interfaces", "geometry_msgs", "nav_msgs", "sensor_msgs", "std_msgs", "std_srvs",
       "diagnostic_msgs", "visualization_msgs", "rosgraph_msgs", "perch_msgs", "tf2_msgs", "ament_index_python")
SOURCES = sorted(p for package in ALLOWED for p in (ROOT / "src" / package / package).rglob("*.py"))


IMPORT = re.compile(r"^[ \t]*(?:from[ \t]+([\w.]+)[ \t]+import\b|import[ \t]+([^#\n]+))", re.MULTILINE)


def imports(path: Path) -> set[str]:
    """Modules; read from the text, which takes a tenth of the time that its syntax takes."""
    names = set()
    for source, modules in IMPORT.findall(path.read_text()):
        names |= {source} if source else {part.split()[0] for part in modules.split(",") if part.split()}
    return names


def test_every_way_to_import_is_read(tmp_path):
    text = "import a.b, c as d  # e\nfrom f.g import (\n    h,\n)\ndef i():\n    from j import k\n    import l\nx = 'import m'\nfrom . import n\n"
    (tmp_path / "one.py").write_text(text)
    assert imports(tmp_path / "one.py") - {"."} == {"a.b", "c", "f.g", "j", "l"}


def test_imports_follow_the_arrows():
    wrong = []
    for path in SOURCES:
        place = path.relative_to(ROOT / "src")
        for name in imports(path):
            first = name.split(".")[0]
            if first.startswith("perch_") and first != "perch_msgs" and first not in ALLOWED[place.parts[0]]:
                wrong.append(f"{place}: imports {name}")
            if first in ROS and not path.name.endswith("_node.py") and "ros" not in place.parts[1:]:
                wrong.append(f"{place}: imports {name}; ROS belongs in *_node.py and folders ros/")
    assert not wrong


TABLE = Path("perch_core", "ros", "topics.py")  # names every channel
OUTSIDE = [p for p in SOURCES if not {"perch_sim", "perch_eval"} & set(p.parts)]
HOST = {Path("perch_core", *parts) for parts in (("component.py",), ("ros", "node.py"), ("ros", "wiring.py"), ("ros", "parameters.py"))}
"""What may mention the lockstep outside the simulator: the list of hosts, the place that chooses one, and what neighbours share with one."""


def mentions(word: str, but: set[Path]) -> list[str]:
    """The sources outside simulator and evaluation, and outside some files of a package, that mention a word."""
    places = [p.relative_to(ROOT / "src") for p in OUTSIDE]
    return [str(place) for path, place in zip(OUTSIDE, places) if place.relative_to(place.parts[0]) not in but and word in path.read_text().lower()]


def test_only_simulator_and_evaluation_know_the_truth():
    assert not mentions("ground_truth", {TABLE})


def test_the_simulator_alone_knows_of_its_lockstep():
    assert not mentions("lockstep", HOST)


def test_the_lockstep_has_no_messages():
    """Its batches are the simulator's own business: nothing of them is on the graph, where others could write, too."""
    messages = [file.name.lower() for file in (ROOT / "src" / "perch_msgs").rglob("*.msg")]
    assert messages and not [name for name in messages if "step" in name or "packet" in name]


def test_every_source_is_seen():
    tracked = subprocess.run(["git", "ls-files", "src/*.py"], cwd=ROOT, capture_output=True, text=True, check=True).stdout
    missing = {ROOT / line for line in tracked.split() if not line.endswith("setup.py")} - set(SOURCES)
    assert len(SOURCES) > 100 and tracked
    assert {p for p in missing if p.exists() and "perch_msgs" not in p.parts} == set()
