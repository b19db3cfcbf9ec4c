"""Random streams of a flight: one seed, and a separate stream for each random source."""

from __future__ import annotations

import zlib

import numpy as np


def stream(seed: int, name: str) -> np.random.Generator:
    """Return the random stream of one source (`imu`, `wind`, `noise_down` ...) of the flight `seed`.

    Streams are spawned from the seed by name, so that none depends on which others exist: switching a camera off does
    not change the IMU's noise.
    """
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(name.encode()),)))
