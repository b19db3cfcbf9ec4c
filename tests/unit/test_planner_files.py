"""Problem files and the script that plans them."""

from __future__ import annotations

import csv
import json
import os
import subprocess
import sys

import numpy as np
import pytest
import yaml
from perch_core import config
from perch_core.errors import ConfigError
from perch_planner.planner import plan
from perch_planner.problem_file import read_problem
from system.scripts import ROOT, call_script

NAMES = ("surface_90", "surface_60", "surface_60_waypoints", "ceiling", "moving_pad")


def mapping(name: str = "surface_90") -> dict:
    return config.read_yaml(config.find("problems", name))


@pytest.mark.parametrize("name", NAMES)
def test_every_example_has_a_plan(name):
    problem, settings, vehicle = read_problem(mapping(name), name)
    assert all(c.holds for c in plan(problem, settings, vehicle).certificates)


@pytest.mark.parametrize("change, words", [
    ({"strat": {}}, "strat"), ({"target": {"position": [0, 0, 1], "inclination_deg": 200.0}}, "inclination_deg: 200"),
    ({"start": {"position": [0, 0]}}, "start.position"), ({"settings": {"solver": "ooqp"}}, "settings.solver"),
    ({"segment_times": [1.0, 1.0]}, "segment_times"), ({"start": {"position": [0, 0, ".nan"]}}, "start.position")])
def test_mistakes_are_named_with_their_file(change, words):
    with pytest.raises(ConfigError) as caught:
        read_problem({**mapping(), **change}, "my.yaml")
    assert "my.yaml" in str(caught.value) and words in str(caught.value)


def test_the_script_writes_samples_coefficients_and_a_picture(tmp_path):
    done = call_script("plan.py", "surface_90", "--out", str(tmp_path))
    assert done.returncode == 0, done.stderr
    assert "the independent verifier finds nothing broken" in done.stdout
    assert done.stdout.splitlines()[-1] == "written: " + ", ".join(str(tmp_path / name) for name in ("plan.csv", "plan.json", "plan.png"))
    written = json.loads((tmp_path / "plan.json").read_text())
    assert all(c["holds"] for c in written["certificates"])
    with (tmp_path / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    t = np.array([float(row["time"]) for row in rows])
    z, vz = (np.array([float(row[key]) for row in rows]) for key in ("z", "vz"))
    assert t[-1] == pytest.approx(written["duration"])
    assert np.gradient(z, t)[5:-5] == pytest.approx(vz[5:-5], abs=2e-3)
    assert float(rows[-1]["z"]) == pytest.approx(1.2) and float(rows[-1]["x"]) == pytest.approx(1.66)
    assert (tmp_path / "plan.png").read_bytes().startswith(b"\x89PNG")


def test_the_script_finds_a_vehicle_beside_the_problem(tmp_path):
    (tmp_path / "heavy.yaml").write_text("extends: snapdragon\nmass: 0.5\n")
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(mapping() | {"vehicle": "heavy.yaml"}))
    done = call_script("plan.py", str(tmp_path / "mine.yaml"), "--out", str(tmp_path / "never"))
    files = f"{tmp_path / 'heavy.yaml'} extends {ROOT / 'config/vehicles/snapdragon.yaml'}"
    assert done.returncode == 2 and f"{files}: speed_max: total thrust 4.50 N cannot lift 0.5 kg" in done.stderr


@pytest.mark.parametrize("arguments, code, words", [
    (("surface_90", "--set", "thrust_max=2.6"), 1, "thrust_floor"), (("no_such_problem",), 2, "no_such_problem"),
    (("surface_90", "--set", "solver=x"), 2, "settings.solver"), ((), 2, "problem is needed"),
    (("surface_90", "--set", "thrust_max=["), 2, "--set: thrust_max=[: is not valid YAML")])
def test_the_script_says_what_is_wrong_by_word_and_exit_code(arguments, code, words, tmp_path):
    done = call_script("plan.py", *arguments, "--out", str(tmp_path / "never"))
    assert done.returncode == code and words in done.stderr and "Traceback" not in done.stderr
    assert not (tmp_path / "never").exists()


@pytest.mark.parametrize("content", ["kind: [perch]", "kind: hover", "- kind"])
def test_the_script_names_the_kinds_there_are(content, tmp_path):
    (tmp_path / "mine.yaml").write_text(content)
    done = call_script("plan.py", str(tmp_path / "mine.yaml"))
    assert done.returncode == 2 and "mine.yaml: kind: " in done.stderr and "is not one of perch, powerline" in done.stderr


def test_the_script_ends_quietly_where_its_output_is_closed():
    reading, writing = os.pipe()
    os.close(reading)
    try:
        done = subprocess.run([sys.executable, ROOT / "scripts" / "plan.py", "surface_90"], stdout=writing, stderr=subprocess.PIPE, text=True)
    finally:
        os.close(writing)
    assert done.returncode == 1 and done.stderr == ""
