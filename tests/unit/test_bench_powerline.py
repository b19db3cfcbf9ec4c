"""The powerline bench goes on where it was interrupted, with the same starts."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from perch_core.errors import PlanningRefusal
from perch_core.vehicle import load_vehicle

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "bench"))
import powerline as bench  # noqa: E402


class Planner:
    """Refuses every start, remembers them, and is interrupted at some."""

    def __init__(self, vehicle):
        pass

    def warm_up(self):
        pass

    def plan(self, request):
        if len(asked) == stops[0]:
            raise KeyboardInterrupt
        asked.append(request.start)
        raise PlanningRefusal("infeasible", "thrust", -1.0, "no")


asked: list[np.ndarray] = []
stops: list[int] = []


def test_an_interrupted_bench_goes_on_with_the_same_starts(monkeypatch, tmp_path):
    monkeypatch.setattr(bench, "STATE", tmp_path)
    monkeypatch.setattr(bench, "PowerlinePlanner", Planner)
    vehicle, runs = load_vehicle("rpg"), []
    for interrupted in ([7], [-1]):
        stops[:] = interrupted
        if interrupted[0] < 0:
            bench._answers(vehicle, 2)
        else:
            with pytest.raises(KeyboardInterrupt):
                bench._answers(vehicle, 2)
        runs.append(len(asked))
    assert runs == [7, 10]
    together = np.array(asked)
    asked.clear()
    monkeypatch.setattr(bench, "STATE", tmp_path / "anew")
    answers = bench._answers(vehicle, 2)
    np.testing.assert_array_equal(together, asked)
    assert [(one["case"], one["start"]) for one in answers] == [(case, k) for case in bench.SOLVE_BARS for k in (0, 1)]
