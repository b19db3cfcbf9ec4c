"""Scores of public recordings, on references made here; the page without any recording, and that of the figures in docs/results."""

from __future__ import annotations

import importlib.util
import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import recordings_scores as scores
import recordings_wires as wires
from perch_core import so3
from scipy.io import savemat

ROOT = Path(__file__).resolve().parents[2]
SQUARE = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]])


def test_a_tag_is_found_where_one_of_its_number_is_within_half_its_side():
    reference = [(0, SQUARE), (0, SQUARE + 100.0), (1, SQUARE + 200.0)]
    found = [(0, SQUARE + (0.3, 0.4)), (0, SQUARE + (100.0, 111.0)), (2, SQUARE + 200.0)]
    errors = list(scores._errors(found, reference))
    assert len(errors) == 1 and errors[0] == pytest.approx(0.5)


def test_a_tag_beyond_the_reference_is_false_unless_it_was_seen_there():
    reference, unlisted = [(0, SQUARE)], [(120, 120)]
    for tag, seen in (((0, SQUARE + 1.0), True), ((0, SQUARE + 100.0), True), ((0, SQUARE + 111.0), False), ((1, SQUARE + 100.0), False)):
        assert scores._is_seen(tag, reference, unlisted) == seen


def test_an_arc_is_on_a_wire_where_it_passes_a_point_of_it():
    arc = np.stack([np.linspace(0.0, 400.0, 9), 100.0 + np.linspace(-1.0, 1.0, 9)**2 * 40.0], axis=1)
    assert wires._is_on(arc, [(0, 0), (200, 107)]) and wires._is_on(arc, [(225, 100)])
    assert not wires._is_on(arc, [(200, 109), (410, 140)]) and not wires._is_on(arc, [])


def test_apriltags_corners_are_in_our_order_and_pixels():
    """AprilTag's (lb, rb, rt, lt) are OpenCV's (TR, TL, BL, BR), and it counts pixels from the first one's corner."""
    lb, rb, rt, lt = SQUARE
    assert scores.ours_of(np.array([lb, rb, rt, lt])) == pytest.approx(np.array([rb, lb, lt, rt]) - 0.5)


def test_a_turn_is_wrong_by_what_it_differs_from_the_file_name():
    turned = {angle: so3.exp(np.radians([0.0, 0.0, angle + off])) for angle, off in ((0, 0.0), (10, 1.0), (-20, 3.0))}
    assert scores._turns(turned) == pytest.approx({"poses": 3, "error_deg_mean": 2.0, "error_deg_max": 3.0})


def test_precision_and_recall_of_wires_are_by_length(tmp_path):
    """Two wires across the image, of which one is traced, and one traced where there is none."""
    (tmp_path / "test").mkdir()
    (tmp_path / "test_gt").mkdir()
    image, edges = np.full((360, 540), 200, np.uint8), np.zeros((360, 540), np.uint8)
    for row in (100, 200):
        cv2.line(image, (0, row), (539, row + 20), 60, 3, cv2.LINE_AA)
    cv2.line(edges, (0, 98), (539, 118), 1)
    cv2.line(edges, (0, 300), (539, 300), 1)
    cv2.imwrite(str(tmp_path / "test" / "1.png"), image)
    inner = np.empty((1, 1), object)
    inner[0, 0] = {"Boundaries": edges}
    savemat(tmp_path / "test_gt" / "1.mat", {"groundTruth": inner})
    right, found, covered, traced = wires._lengths(tmp_path / "test" / "1.png", tmp_path / "test_gt" / "1.mat")
    assert right / found == pytest.approx(0.5, abs=0.02) and covered / traced == pytest.approx(0.5, abs=0.02)


@pytest.fixture
def bench(monkeypatch):
    """`bench/recordings.py`; as `recordings` the tests know another package."""
    spec = importlib.util.spec_from_file_location("bench_recordings", ROOT / "bench" / "recordings.py")
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look for it there
    spec.loader.exec_module(module)
    return module


def test_a_page_without_recordings_says_so(bench):
    page = "\n".join(bench.page({}, "a command", {"commit": "", "digest": ""}))
    assert page.count(bench.MISSING) == 18 and all(recording.title in page for recording in bench.RECORDINGS.values())


@pytest.mark.parametrize("errors, nees, verdict", [
    ([0.1, 0.2], 1.0, "holds (2 of 2)"), ([0.1, 0.21, 0.3], 1.0, "fails (1 of 3)"), ([0.1, 0.2], 1.1, "fails (2 of 2)")])
def test_racing_motion_holds_where_every_seed_does_and_the_covariance_is_true(bench, errors, nees, verdict):
    assert verdict in bench.race({"flight": "a", "path_m": 40.0, "error_percent": errors, "nees": nees, "lost": 0})


@pytest.mark.parametrize("key, figures, verdict", [
    ("v101", {"final_error_m": 0.01}, "holds"), ("v101", {"final_error_m": 0.011}, "fails"), ("v101", {"final_error_m": None}, "fails"),
    ("v101_flight", {"drift_percent": 2.9}, "holds"), ("v101_flight", {"drift_percent": 3.1}, "fails"),
    ("mh01", {"final_error_m": 0.05, "attitude_rms_deg": 1.5}, "holds"), ("mh01", {"final_error_m": 0.05, "attitude_rms_deg": 1.6}, "fails")])
def test_odometry_holds_where_every_figure_is_within_its_bar_and_the_covariance_is_true(bench, key, figures, verdict):
    assert bench.required(key, figures | {"nees_position_mean": 2.9}).startswith(verdict)
    assert bench.required(key, figures | {"nees_position_mean": 3.1}).startswith("fails")


def test_the_page_is_that_of_its_figures(bench):
    folder = ROOT / "docs" / "results" / "recordings"
    page = "\n".join(bench.page(json.loads((folder / "results.json").read_text())["recordings"], "a command", {"commit": "", "digest": ""}))
    assert page.partition(bench.INTRODUCTION)[2] == (folder / "README.md").read_text().rstrip("\n").partition(bench.INTRODUCTION)[2]


def test_a_recording_that_is_missing_keeps_its_figures_of_the_same_code(bench, monkeypatch, tmp_path, capsys):
    written = json.loads((ROOT / "docs" / "results" / "recordings" / "results.json").read_text())
    monkeypatch.setattr(bench, "code_version", lambda: {"commit": "1234567", "digest": "0123456789ab"})
    (tmp_path / "results.json").write_text(json.dumps(written | {"digest": "0123456789ab"}))
    assert bench.main([str(tmp_path), "--only", "nasa", "--out", str(tmp_path)]) == 0
    assert "nasa: " in (said := capsys.readouterr().out) and "is missing: git clone https://github.com/AprilRobotics/apriltag" in said
    assert json.loads((tmp_path / "results.json").read_text())["recordings"] == written["recordings"]


@pytest.mark.parametrize("words", [("typo",), ("typo", "--only", "floor"), (".",)])
def test_a_folder_without_recordings_does_not_replace_the_page(bench, monkeypatch, tmp_path, capsys, words):
    monkeypatch.chdir(tmp_path)
    assert bench.main([*words, "--out", "out"]) == 2
    assert f"FOLDER: {words[0]}: is no folder with recordings; --help shows how" in capsys.readouterr().err and not Path("out").exists()
