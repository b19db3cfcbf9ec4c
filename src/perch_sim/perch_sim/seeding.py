"""One seed for a flight, and a stream of its own for everything that is random."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """The random stream of one source (`imu`, `wind`, `camera_down` ...) of the flight `seed`.

    Streams are spawned from the seed by name, so that none depends on which others exist: a camera that is switched
    off does not change the IMU's noise.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),)))
