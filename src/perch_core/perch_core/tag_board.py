"""Boards of AprilTags on the perching pad: where each tag's corners are in the surface frame S.

Seen from outside with s1 up, the left is +s2. OpenCV's frame of a 36h11 marker is rotated by 180 deg against
AprilTag's own: AprilTag's corners (lb, rb, rt, lt) are OpenCV's (TR, TL, BL, BR), and AprilTag counts pixels from
the corner of the first one (+0.5). Corners here are in the order of OpenCV's detector.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from perch_core import config
from perch_core.errors import ConfigError

CORNER_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])  # TL, TR, BR, BL in (s1, s2)


@dataclass(frozen=True)
class Tag:
    """One marker on a board."""

    id: int = config.quantity(low=0, high=586, doc="number in the family 36h11")
    centre: tuple[float, float] = config.quantity(unit="m", low=-10.0, high=10.0, doc="centre along s1 and s2")
    size: float = config.quantity(unit="m", above=0.0, high=10.0, doc="side of the black border, outer edge")
    rotation: float = config.quantity(0.0, unit="deg", low=-360.0, high=360.0,
                                      doc="turn of the marker about s3, counter-clockwise seen from outside")


@dataclass(frozen=True)
class TagBoard:
    """Tags on a pad.

    Attributes:
        family: marker family; 36h11 is the one that is detected.
        pad_size: full extent of the pad along s1 and s2 [m].
        tags: the markers.
    """

    pad_size: tuple[float, float] = config.quantity(unit="m", above=0.0, high=10.0, doc="pad along s1 and s2")
    tags: tuple[Tag, ...] = ()
    family: str = config.choice("36h11", options=("36h11",), doc="marker family")

    def __post_init__(self) -> None:
        if not self.tags:
            raise ConfigError("TagBoard", "tags", "a board needs at least one tag")
        ids = [tag.id for tag in self.tags]
        if len(set(ids)) != len(ids):
            raise ConfigError("TagBoard", "tags", f"the ids {ids} are not all different")
        outside = np.any(np.abs(self.corners_S[..., :2]) > np.array(self.pad_size) / 2 + 1e-9, axis=(1, 2))
        if outside.any():
            raise ConfigError("TagBoard", f"tags[{int(outside.argmax())}].centre",
                              f"tag {ids[int(outside.argmax())]} reaches beyond the pad of {self.pad_size} m")

    @property
    def ids(self) -> tuple[int, ...]:
        """Numbers of the tags, in the order of `corners_S`."""
        return tuple(tag.id for tag in self.tags)

    @cached_property
    def corners_S(self) -> np.ndarray:
        """Corners in S [m], shape (n, 4, 3), in the order TL, TR, BR, BL of the marker image."""
        corners = np.zeros((len(self.tags), 4, 3))
        for tag, corner in zip(self.tags, corners):
            c, s = np.cos(np.radians(tag.rotation)), np.sin(np.radians(tag.rotation))
            turn = np.array([[c, -s], [s, c]])
            corner[:, :2] = np.array(tag.centre) + 0.5 * tag.size * CORNER_SIGNS @ turn.T
        corners.flags.writeable = False
        return corners


def load_board(name_or_path: str | Path) -> TagBoard:
    """Read `config/boards/<name>.yaml`, or the file named.

    Raises:
        ConfigError: no such board, or a value that is not usable.
    """
    return config.load(TagBoard, config.find("boards", name_or_path))
