"""Error models in place of images: sightings of the pad with the measured error of the tag pipeline, and a map of the cables.

The pad's model replaces the image, not the localiser: the board's corners are projected with the *true* camera (its
calibration errors included), disturbed by the error of `perch_perception.tags` on rendered images (0.06 px at 1.7 m,
0.18 px at 3 m), and the pose is solved with the nominal camera by the same code as in flight. Blur, contrast and light
are not modelled.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from perch_core import so3
from perch_core.component import Component, Input, Output
from perch_core.config import quantity, text
from perch_core.errors import PerchError
from perch_core.lines import Segment
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_core.values import NANOSECONDS, CameraModel, MappedPowerline, PowerlineMap
from perch_core.vehicle import load_vehicle
from perch_perception.pose_buffer import BodyState
from perch_perception.tags import Localization, LocalizationRefusal, average_board, solve_board
from perch_perception.tags.localizer import LOST_AFTER, MIN_RANGE, SEARCH_PERIOD
from perch_perception.target_localizer import TargetLocalizer, TargetLocalizerConfig
from perch_sim import seeding
from perch_sim.calibration import true_mounts
from perch_sim.scenario import Cable, Scenario, load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle
from perch_sim.state_history import StateHistory, TrueState

TRUTH_BUFFER = 200     # true states kept: 0.4 s
MIN_TAG_SIDE = 12.5    # a tag whose shortest side is smaller is not found [px]: 0.16 m at 3.5 m
_REFERENCE_SIDE, _REFERENCE_SIGMA = 25.9, 0.06          # shortest side of a tag [px] and its corners' error there [px]
_GROWTH = np.log(0.18 / 0.06) / np.log(3.0 / 1.7)       # exponent with which that grows as the side shrinks
_MAX_SIGMA = 0.6                                        # [px]
MAP_ERROR = 0.02  # 1 sigma of each axis of both ends of a mapped line [m]; the mapper's bar is 3 cm
MAP_PERIOD = 100_000_000  # [ns]


def corner_sigma(side: np.ndarray) -> np.ndarray:
    """Return 1 sigma of a measured corner along each image axis for the tag's shortest side, both [px]."""
    return np.clip(_REFERENCE_SIGMA * (_REFERENCE_SIDE / np.maximum(side, 1.0)) ** _GROWTH, 0.05, _MAX_SIGMA)


def modelled_target_localizer(config: TargetLocalizerConfig, vehicle: SimulatedVehicle, seed: int) -> TargetLocalizer:
    """Create a target localiser whose sightings are computed from the true state."""
    simulation, truth = vehicle.simulation, StateHistory(TRUTH_BUFFER)
    truth.append(simulation.state)  # an exposure may have its middle before the first step ends
    vehicle.truth.receivers.append(lambda _: truth.append(simulation.state))
    return TargetLocalizer(config, ModelledLocalizer(config, simulation.scenario, seed, truth, lambda: simulation.pad))


class ModelledLocalizer:
    """Localiser that computes sightings of the board from the true state, in place of `BoardLocalizer`."""

    def __init__(self, config: TargetLocalizerConfig, scenario: Scenario, seed: int, truth: StateHistory, pad: Callable[[], PerchSurface]) -> None:
        """
        Args:
            config: parameters of the localiser.
            scenario: scenario with the vehicle and its calibration errors.
            seed: seed of the calibration's and the corners' errors.
            truth: recent true states of the vehicle.
            pad: returns the present true pad.

        Raises:
            ConfigError: there is no such vehicle or board.
        """
        self._truth, self._pad, self._config = truth, pad, config
        self._board, self._mount = load_board(config.board), load_vehicle(scenario.vehicle).mounts[config.camera]
        self._true = true_mounts(scenario, {config.camera: self._mount}, seed)[config.camera]
        self._rng = seeding.stream(seed, "tag_corners")
        self._last = self._last_search = -np.inf
        self._R_CS: np.ndarray | None = None

    def process(self, image: Any, exposure_time: float, body: BodyState | None) -> Localization:
        """Return the modelled localisation of an image, whose content is ignored; arguments as those of `Localizer.process`."""
        tracking = exposure_time - self._last <= LOST_AFTER
        if not tracking:
            self._R_CS = None
            if exposure_time - self._last_search < SEARCH_PERIOD - 1e-3:
                return Localization(None, message="waiting for the next search")
            self._last_search = exposure_time
        try:
            state = self._truth.at(self.middle(exposure_time))
        except LookupError as error:  # an image from before the first true state
            return Localization(None, message=str(error))
        pixels, ids, side = self._visible(state, self._pad())
        if not ids:
            return Localization(None, message="no tag of the board found")
        sigma = np.repeat(corner_sigma(side)[:, None], 4, axis=1)
        measured = pixels + sigma[..., None] * self._rng.standard_normal(pixels.shape)
        rays = self._mount.camera.unproject(measured.reshape(-1, 2)).reshape(-1, 4, 3)
        corners_S = self._board.corners_S[[self._board.ids.index(i) for i in ids]]
        try:
            pose = solve_board(self._mount.camera, corners_S, rays, sigma, ids, self._R_CS, lens_sigma=self._config.calibration.lens)
        except LocalizationRefusal as refusal:
            return Localization(None, message=str(refusal))
        if not MIN_RANGE <= np.linalg.norm(pose.p_CS) <= self._config.max_range:
            return Localization(None, message="not a board of this size")
        self._last, self._R_CS = exposure_time, pose.R_CS
        complete = len(ids) == len(self._board.ids)
        average = average_board(self._mount.camera, corners_S, rays, ids) if self._config.mode == "average" and complete else None
        return Localization(pose, average, complete)

    def middle(self, exposure_time: float) -> int:
        """Return the true middle of an exposure [ns], which by the calibrated stamp offset is at `exposure_time` [s]."""
        stamp = round((exposure_time + self._mount.stamp_offset) * NANOSECONDS)
        return stamp - round(self._true.stamp_offset * NANOSECONDS)

    def _visible(self, state: TrueState, pad: PerchSurface) -> tuple[np.ndarray, tuple[int, ...], np.ndarray]:
        """Return true pixels (n, 4, 2), ids and shortest sides (n,) [px] of the detectable tags."""
        p_WC, R_WC = self._true.pose(state.p_WB, so3.quat_to_matrix(state.q_WB))
        if (p_WC - pad.p_WS) @ pad.normal <= 0.05:
            return np.zeros((0, 4, 2)), (), np.zeros(0)
        corners_W = pad.p_WS + self._board.corners_S @ pad.R_WS.T
        pixels, valid = self._true.camera.project(((corners_W - p_WC) @ R_WC).reshape(-1, 3))
        inside = (valid & self._true.camera.contains(pixels, margin=1.0)).reshape(-1, 4).all(axis=1)
        pixels = pixels.reshape(-1, 4, 2)
        side = np.linalg.norm(np.roll(pixels, -1, axis=1) - pixels, axis=2).min(axis=1)
        keep = inside & (side >= MIN_TAG_SIDE)
        return pixels[keep], tuple(np.array(self._board.ids)[keep].tolist()), side[keep]


@dataclass(frozen=True)
class NoParameters:
    """Parameters of a component without parameters."""


@dataclass(frozen=True)
class MapParameters:
    """Parameters of the modelled map."""

    scenario: str = text("line_80", doc="config/scenarios/<name>.yaml, or a file")
    seed: int = quantity(1, low=0, high=2**31 - 1, doc="of everything that is random")
    camera: str = text("front", doc="camera whose frames start the map")


class ModelledMap(Component[MapParameters]):
    """Map with the error of the mapper, published at 10 Hz, in place of `powerline_mapper`: every cable at full length from the
    first camera frame on, whether or not it is in view."""

    config_type = MapParameters

    frame = Input(CameraModel, "camera_{camera}/camera_info")
    powerlines = Output(PowerlineMap, "powerlines")

    def __init__(self, config: MapParameters, scenario: Scenario | None = None) -> None:
        """
        Args:
            config: parameters.
            scenario: scenario with the cables; None: that of `config`.

        Raises:
            ConfigError: there is no such scenario.
            PerchError: a cable sags; the error model is limited to straight lines.
        """
        super().__init__(config)
        scenario, rng = scenario or load_scenario(config.scenario), seeding.stream(config.seed, "line_map")
        if any(cable.sag > 0.0 for cable in scenario.world.cables):
            raise PerchError(f"scenario {scenario.name}: cables that sag have no error model; sensing.target must be rendered")
        self._lines = tuple(_mapped_line(k, cable, rng) for k, cable in enumerate(scenario.world.cables))
        self._next = 0

    def on_frame(self, frame: CameraModel) -> None:
        """Publish the map if it is due at this frame."""
        if frame.stamp >= self._next:
            self._next = frame.stamp + MAP_PERIOD
            self.powerlines(PowerlineMap(frame.stamp, self._lines, False, ""))


def _mapped_line(number: int, cable: Cable, rng: np.random.Generator) -> MappedPowerline:
    """Return a cable as mapped: each axis of both ends has an error of `MAP_ERROR` (1 sigma)."""
    true = Segment.between(np.array(cable.start), np.array(cable.end), cable.radius, number)
    first, last = (end + MAP_ERROR * rng.normal(size=3) for end in true.ends)
    line = Segment.between(first, last, cable.radius, number)
    start, end = (tuple(place.tolist()) for place in line.ends)
    sigma = MAP_ERROR * np.sqrt(2.0) / (2.0 * line.half_length)
    return MappedPowerline(number, start, end, cable.radius, MAP_ERROR**2 * np.eye(3), sigma, 100)
