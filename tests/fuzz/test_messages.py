"""Messages: what was found once stays mended, and some new games; the long form is `scripts/fuzz.py messages`."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from perch_core.values import ImuSample
from fuzzing import messages
from fuzzing.messages import Nonsense, Spoilt, drawn, hunt, play, replay
from fuzzing.spoiled import Way

CASES = sorted((Path(__file__).parent / "cases" / "messages").glob("*.json"))
PLAYERS = [("surface", name) for name in ("estimator", "controller", "mission", "vehicle", "description", "vio_model")]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.stem)
def test_what_was_found_stays_mended(case):
    text = case.read_text()
    count = replay(text)
    assert count["refused"] + count["taken"] == len(json.loads(text)["sent"])


@pytest.mark.parametrize("flight, name", PLAYERS, ids=[name for _, name in PLAYERS])
def test_nonsense_is_refused_and_leaves_no_trace_and_anything_leaves_sense(flight, name):
    seeds = iter(range(100))
    strict = next(seed for seed in seeds if drawn(flight, name, seed)[1])
    free = next(seed for seed in seeds if not drawn(flight, name, seed)[1] and len(drawn(flight, name, seed)[0]) <= 100)
    count = hunt(flight, name, strict) + hunt(flight, name, free)
    assert count["refused"] >= 3 and count["valid"] > 200


def test_the_oracles_know_nonsense(monkeypatch):
    events = messages.recorded("surface")["estimator"]
    imu = next(k for k, event in enumerate(events) if k > 1000 and event.method == "on_imu" and isinstance(event.arguments[0], ImuSample))
    shaken = [Spoilt(imu, imu, (Way(("linear_acceleration", "z"), "=", 5000.0),))]
    play("surface", "estimator", shaken, True, imu + 50)
    monkeypatch.setattr("perch_core.component.problem", lambda value: "")
    with pytest.raises(Nonsense, match="has moved the outputs"):
        play("surface", "estimator", shaken, True, imu + 50)
    monkeypatch.setattr(messages, "drawn", lambda flight, name, seed: (shaken, True, imu + 50))
    with pytest.raises(Nonsense) as found:
        hunt("surface", "estimator", 0)
    assert '"on_imu"' in found.value.case
    with pytest.raises(Nonsense, match="has moved the outputs"):
        replay(found.value.case)
