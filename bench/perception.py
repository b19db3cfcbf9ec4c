"""Bars of perception: tags, lines, VIO and UKF in one group."""

from __future__ import annotations

import perception_lines
import perception_tags
import perception_vio
from harness import Figure

SEEDS = "lines: scene 1, flights from 0; tags: 5; VIO: flights from 0, IMU 1"


def figures(quick: bool) -> list[Figure]:
    """The figures of all parts."""
    return [figure for part in (perception_lines, perception_tags, perception_vio) for figure in part.figures(quick)]
