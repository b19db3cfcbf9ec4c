"""Components that take the place of others in a flight: an error model for what a camera would have found."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from perch_core.component import Component, Input, Output
from perch_core.errors import PerchError
from perch_core.lines import Segment
from perch_sim.scenario import Scenario
from perch_core.values import CameraModel, MappedPowerline, PowerlineMap
from perch_sim import seeding

MAP_ERROR = 0.02  # 1 sigma of each axis of both ends of a mapped line [m]; the mapper's bar is 3 cm
MAP_PERIOD = 100_000_000  # [ns]


@dataclass(frozen=True)
class NoParameters:
    """Of a component that has none."""


@dataclass(frozen=True)
class MappedWorldParameters:
    """What there is to be mapped, and when."""

    camera: str
    lines: tuple[Segment, ...]


def mapped(lines: Sequence[Segment], rng: np.random.Generator) -> tuple[Segment, ...]:
    """Lines as a mapper finds them: each end is off by `MAP_ERROR`."""
    out = []
    for line in lines:
        start, end = (end + MAP_ERROR * rng.normal(size=3) for end in line.ends)
        out.append(Segment.between(start, end, line.radius, line.id))
    return tuple(out)


class MappedWorld(Component[MappedWorldParameters]):
    """A map with the mapper's error, ten times a second of the camera's frames, in the place of `powerline_mapper`."""

    config_type = MappedWorldParameters

    frame = Input(CameraModel, "camera_{camera}/camera_info")
    powerlines = Output(PowerlineMap, "powerlines")

    def __init__(self, config: MappedWorldParameters) -> None:
        super().__init__(config)
        length = [2.0 * line.half_length for line in config.lines]
        self._lines = tuple(
            MappedPowerline(line.id, tuple(line.ends[0].tolist()), tuple(line.ends[1].tolist()), line.radius, MAP_ERROR**2 * np.eye(3),
                            MAP_ERROR * np.sqrt(2.0) / along, 100) for line, along in zip(config.lines, length))
        self._next = 0

    def on_frame(self, frame: CameraModel) -> None:
        """The map of a frame."""
        if frame.stamp >= self._next:
            self._next = frame.stamp + MAP_PERIOD
            self.powerlines(PowerlineMap(frame.stamp, self._lines, False, ""))

    @classmethod
    def of(cls, scenario: Scenario, seed: int) -> MappedWorld:
        """The map of a scenario's cables, which must not sag.

        Raises:
            PerchError: one does: there is no error model for a map of curves.
        """
        if any(cable.sag > 0.0 for cable in scenario.world.cables):
            raise PerchError(f"scenario {scenario.name}: cables that sag have no error model; sensing.target must be rendered")
        lines = [Segment.between(np.array(c.start), np.array(c.end), c.radius, k) for k, c in enumerate(scenario.world.cables)]
        return cls(MappedWorldParameters("front", mapped(lines, seeding.stream(seed, "line_map"))))
