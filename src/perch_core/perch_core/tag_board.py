"""Boards of AprilTags on the perching pad: positions of the tags' corners in the surface frame S.

A board is a list of tags, or a grid as Kalibr prints it: `columns` x `rows` tags, numbered along the rows from `first_id`,
with black squares of the gap's width between their corners and a black border of two modules.

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

FAMILIES = {"16h5": (4, 30), "25h9": (5, 35), "36h10": (6, 2320), "36h11": (6, 587)}
"""AprilTag families that OpenCV supports: modules of the code along a side, and number of tags."""
TAGS_MAX = 100  # of a board that is localised: its pose takes 0.07 s, and the time grows with the cube of the number
CORNER_SIGNS = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])  # TL, TR, BR, BL in (s1, s2)


@dataclass(frozen=True)
class Tag:
    """One marker on a board."""

    id: int = config.quantity(low=0, high=2319, doc="number in the family")
    centre: tuple[float, float] = config.quantity(unit="m", low=-10.0, high=10.0, doc="centre along s1 and s2")
    size: float = config.quantity(unit="m", above=0.0, high=10.0, doc="side of the black border, outer edge")
    rotation: float = config.quantity(0.0, unit="deg", low=-360.0, high=360.0,
                                      doc="turn of the marker about s3, counter-clockwise seen from outside")


@dataclass(frozen=True)
class TagGrid:
    """Equal tags in rows and columns, the first at the lower left (-s1, +s2)."""

    columns: int = config.quantity(low=1, high=50, doc="tags along a row")
    rows: int = config.quantity(low=1, high=50, doc="rows, from below")
    size: float = config.quantity(unit="m", above=0.0, high=10.0, doc="side of a tag's black border, outer edge")
    spacing: float = config.quantity(0.3, low=0.0, high=10.0, doc="gap between tags, as a share of their size")
    first_id: int = config.quantity(0, low=0, high=2319, doc="number of the first tag; they grow along the rows")
    rotation: float = config.quantity(0.0, unit="deg", low=-360.0, high=360.0, doc="turn of every tag about s3, as of `Tag`")

    @property
    def tags(self) -> tuple[Tag, ...]:
        """The tags, with the grid's centre at the origin."""
        step = self.size * (1.0 + self.spacing)
        return tuple(Tag(self.first_id + row * self.columns + column,
                         (step * (row - 0.5 * (self.rows - 1)), -step * (column - 0.5 * (self.columns - 1))), self.size, self.rotation)
                     for row in range(self.rows) for column in range(self.columns))


@dataclass(frozen=True)
class TagBoard:
    """Tags on a pad.

    Attributes:
        pad_size: full extent of the pad along s1 and s2 [m].
        tags: the markers; those of `grid`, if one is given.
        family: marker family, one of `FAMILIES`.
        border: width of the tags' black border [modules]: 1, but 2 on Kalibr's AprilGrid.
        corner_squares: whether black squares touch the tags at their corners, as on an AprilGrid.
        grid: tags in rows and columns, instead of a list.
    """

    pad_size: tuple[float, float] = config.quantity(unit="m", above=0.0, high=10.0, doc="pad along s1 and s2")
    tags: tuple[Tag, ...] = ()
    family: str = config.choice("36h11", options=tuple(FAMILIES), doc="marker family")
    border: int = config.quantity(1, low=1, high=4, doc="black border of a tag [modules]")
    corner_squares: bool = False
    grid: TagGrid | None = None

    def __post_init__(self) -> None:
        if self.grid is not None:
            if self.tags not in ((), self.grid.tags):
                raise ConfigError("TagBoard", "tags", "a board has a list of tags or a grid, not both")
            object.__setattr__(self, "tags", self.grid.tags)
        if not self.tags:
            raise ConfigError("TagBoard", "tags", "a board needs at least one tag")
        ids, count = [tag.id for tag in self.tags], FAMILIES[self.family][1]
        if len(set(ids)) != len(ids):
            raise ConfigError("TagBoard", "tags", f"the ids {ids} are not all different")
        if max(ids) >= count:
            raise ConfigError("TagBoard", "tags", f"id {max(ids)} is outside [0, {count - 1}], the numbers of the family {self.family}")
        outside = np.any(np.abs(self.corners_S[..., :2]) > np.array(self.pad_size) / 2 + 1e-9, axis=(1, 2))
        if outside.any():
            raise ConfigError("TagBoard", f"tags[{int(outside.argmax())}].centre",
                              f"tag {ids[int(outside.argmax())]} reaches beyond the pad of {self.pad_size} m")

    @property
    def modules(self) -> int:
        """Width of a tag between the outer edges of its border [modules]."""
        return FAMILIES[self.family][0] + 2 * self.border

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
    """Read `config/boards/<name>.yaml`, or a file.

    Raises:
        ConfigError: no such board, or a value that is not usable.
    """
    path = config.find("boards", name_or_path)
    board = config.load(TagBoard, path)
    if len(board.tags) > TAGS_MAX:
        raise ConfigError(str(path), "tags" if board.grid is None else "grid", f"{len(board.tags)} tags are more than {TAGS_MAX}")
    return board
