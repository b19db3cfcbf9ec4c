"""JSON files are written whole or not at all."""

from __future__ import annotations

import json
import math
from pathlib import Path

import pytest

from perch_core.json_values import write_json


def test_a_file_replaces_the_earlier_one_and_nan_is_null(tmp_path):
    file = tmp_path / "results.json"
    for value in (1.0, math.nan):
        write_json(file, {"x": value})
    assert json.loads(file.read_text()) == {"x": None} and list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_an_interrupted_file_leaves_the_earlier_one(tmp_path, monkeypatch, error):
    file, write_text = tmp_path / "results.json", Path.write_text
    write_json(file, {"x": 1})

    def cut_off(path, text):
        write_text(path, text[:3])
        raise error

    monkeypatch.setattr(Path, "write_text", cut_off)
    with pytest.raises(type(error)):
        write_json(file, {"x": 2})
    assert json.loads(file.read_text()) == {"x": 1} and list(tmp_path.iterdir()) == [file]
