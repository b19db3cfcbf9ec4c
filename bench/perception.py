"""Bars of perception: tags, lines, VIO and UKF in one group."""

from __future__ import annotations

import perception_lines
import perception_tags
import perception_vio
from harness import Figure


def figures(quick: bool) -> list[Figure]:
    """The figures of all parts."""
    return [figure for part in (perception_lines, perception_tags, perception_vio) for figure in part.figures(quick)]
