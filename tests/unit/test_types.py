"""Mypy finds nothing: packages and settings in mypy.ini."""

from __future__ import annotations

import importlib.util
import subprocess
import sys

import numpy as np
import pytest

from perch_setup.layout import ROOT


@pytest.mark.skipif(importlib.util.find_spec("mypy") is None, reason="mypy is not installed: python3 scripts/setup.py --extra test")
@pytest.mark.skipif(np.lib.NumpyVersion(np.__version__) < "2.2.0", reason="numpy's own types are older than 2.2: np.ndarray needs parameters there")
def test_mypy_finds_nothing():
    done = subprocess.run([sys.executable, "-m", "mypy", "--no-error-summary"], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
