"""Error models in place of images: sightings of the pad and a map of the cables, with the measured errors of tag pipeline and mapper.

The pad's model replaces the image, not the localiser: the board's corners are projected with the *true* camera (its
calibration errors included), disturbed by the error of `perch_perception.tags` on rendered images (0.06 px at 1.7 m,
0.18 px at 3 m), and the pose is solved with the nominal camera by the same code as in flight. Blur, contrast and light
are not modelled.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, TypeVar

import numpy as np

from perch_core import so3
from perch_core.camera_mount import CameraMount
from perch_core.component import Input, Output
from perch_core.config import quantity, text
from perch_core.errors import PerchError
from perch_core.lines import Segment
from perch_core.surface import PerchSurface
from perch_core.tag_board import load_board
from perch_core.values import NANOSECONDS, CameraImage, CameraModel, MappedPowerline, OdometryState, PowerlineMap, nanoseconds
from perch_core.vehicle import load_vehicle
from perch_perception.camera_component import CameraConfig, PosedCameraComponent
from perch_perception.pose_buffer import BodyState, StampError
from perch_perception.powerline_mapper import PowerlineMapperConfig
from perch_perception.tags import Localization, LocalizationRefusal, average_board, solve_board
from perch_perception.tags.localizer import LOST_AFTER, MIN_RANGE, SEARCH_PERIOD
from perch_perception.target_localizer import TargetLocalizer, TargetLocalizerConfig
from perch_sim import seeding
from perch_sim.calibration import true_mounts
from perch_sim.scenario import Scenario, load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle
from perch_sim.state_history import StateHistory, TrueState

TRUTH_BUFFER = 200     # true states kept: 0.4 s
LONG_TRUTH_BUFFER = 1000  # 2 s, as frames wait for the odometry
MIN_TAG_SIDE = 12.5    # a tag whose shortest side is smaller is not found [px]: 0.16 m at 3.5 m
_REFERENCE_SIDE, _REFERENCE_SIGMA = 25.9, 0.06          # shortest side of a tag [px] and its corners' error there [px]
_GROWTH = np.log(0.18 / 0.06) / np.log(3.0 / 1.7)       # exponent with which that grows as the side shrinks
_MAX_SIGMA = 0.6                                        # [px]
# Errors of a mapped line relative to the vehicle, 1 sigma, from four rendered flights of line_80 (seeds 1 to 4, 696 images): along
# the view 5.0 cm at 3.5 to 4.5 m, 1.1 cm at 2 to 2.5 m, 2.0 cm at 1 to 2 m, 0.9 cm below 0.3 m; across 2.6, 1.1, 0.9 and 0.4 cm;
# the direction 0.4 to 0.5 deg.
DEPTH_ERROR, ACROSS_ERROR = 0.010, 0.005  # of the distance, along the view and across
LEAST_ERROR = 0.003                       # besides, both [m]
DIRECTION_ERROR = np.radians(0.45)


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
class MapParameters(PowerlineMapperConfig):
    """Parameters of the mapper, and scenario and seed of the truth."""

    scenario: str = text("line_80", doc="config/scenarios/<name>.yaml, or a file")
    seed: int = quantity(1, low=0, high=2**31 - 1, doc="of everything that is random")


C = TypeVar("C", bound=CameraConfig)


class ModelledSight(PosedCameraComponent[C]):
    """Camera component that sees by the true states of the vehicle; a frame's `camera_info` replaces its image.

    Attributes:
        true_states: the recent ones, made by the subclass.
    """

    image = None  # type: ignore[assignment]
    truth = Input(OdometryState, "ground_truth/odometry")

    true_states: StateHistory

    @abstractmethod
    def middle(self, exposure_time: float) -> int:
        """Return the true middle of an exposure [ns], which by the calibrated stamp offset is at `exposure_time` [s]."""

    def on_truth(self, state: OdometryState) -> None:
        """Add a true state, and process frames that waited for it."""
        if state.stamp > self.true_states.newest:
            self.true_states.append(TrueState(state.stamp, np.array((*state.p_WB, *state.q_WB, *state.v_WB, *state.w_B))))
        self.advance()

    def on_camera_info(self, model: CameraModel) -> None:
        """Process a frame as an image without pixels."""
        super().on_camera_info(model)
        self.on_image(CameraImage(model.stamp, model.frame, model.camera.width, model.camera.height, "mono8", lambda *_: None))

    def is_ready(self, image: CameraImage) -> bool:
        """As in the base class, and additionally whether the truth has passed the exposure."""
        return super().is_ready(image) and self.middle(self._exposure_time(image)) <= self.true_states.newest

    def _channel(self, port: str) -> str:
        return f"camera_{self.config.camera}/camera_info"


class ModelledMap(ModelledSight[MapParameters]):
    """Map with the errors of the mapper, in place of `powerline_mapper`.

    As the mapper's, the place of a cable is that relative to the vehicle when it was last in view, in the frame of the odometry
    without its corrections: drift moves it only while it is out of view. Its error is a share of the distance, the same share
    throughout a flight. A cable is mapped at full length from the first frame that shows a part of it.
    """

    config_type = MapParameters

    powerlines = Output(PowerlineMap, "powerlines")

    def __init__(self, config: MapParameters, scenario: Scenario | None = None) -> None:
        """
        Args:
            config: parameters.
            scenario: scenario with the cables; None: that of `config`.

        Raises:
            ConfigError: there is no such scenario, vehicle or camera.
            PerchError: a cable sags; the error model is limited to straight lines.
        """
        super().__init__(config)
        scenario, rng = scenario or load_scenario(config.scenario), seeding.stream(config.seed, "line_map")
        if any(cable.sag > 0.0 for cable in scenario.world.cables):
            raise PerchError(f"scenario {scenario.name}: cables that sag have no error model; sensing.target must be rendered")
        self._cables = [ModelledCable(Segment.between(np.array(cable.start), np.array(cable.end), cable.radius, k), *rng.normal(size=(2, 2)))
                        for k, cable in enumerate(scenario.world.cables)]
        self.true_states, self._last_used = StateHistory(LONG_TRUTH_BUFFER), -np.inf

    def use_camera(self, mount: CameraMount) -> None:
        """Nothing depends on the camera before its frames."""

    def middle(self, exposure_time: float) -> int:
        """Return the exposure's middle as calibrated: the stamp offset has no error in this model."""
        return nanoseconds(exposure_time)

    def process_image(self, image: CameraImage, exposure_time: float) -> None:
        """Place the cables in view, unless the frame exceeds `rate`, and publish the map."""
        if exposure_time - self._last_used < 1.0 / self.config.rate - 1e-3:
            return
        self._last_used = exposure_time
        try:
            body, true = self.bodies.at(exposure_time), self.true_states.at(self.middle(exposure_time))
        except (StampError, LookupError) as error:
            self.warn(f"frame not used: {error}", 1.0)
            return
        for cable in self._cables:
            cable.look(self.mounted.known, true, body)
        lines = tuple(cable.mapped(body) for cable in self._cables if cable.moved is not None)
        self.powerlines(PowerlineMap(nanoseconds(exposure_time), lines, False, ""))


class ModelledCable:
    """A cable and its place in the modelled map.

    Attributes:
        moved: from its true place to the mapped one, without the odometry's corrections [m], shape (3,); None: not seen yet.
    """

    def __init__(self, cable: Segment, place: np.ndarray, turn: np.ndarray) -> None:
        """
        Args:
            cable: the true cable.
            place: error of its place in sigmas: along the view and across, shape (2,).
            turn: error of its direction in sigmas: towards the vertical and horizontally, shape (2,).
        """
        self._cable, self._place = cable, place
        level = np.cross(cable.direction, [0.0, 0.0, 1.0] if abs(cable.direction[2]) < 0.7 else [1.0, 0.0, 0.0])
        level /= np.linalg.norm(level)
        turned = cable.direction + DIRECTION_ERROR * (turn[0] * np.cross(level, cable.direction) + turn[1] * level)
        self._direction, self._covariance = turned / np.linalg.norm(turned), np.zeros((3, 3))
        self.moved: np.ndarray | None = None

    def look(self, mount: CameraMount, true: TrueState, body: BodyState) -> None:
        """Place the cable anew if a part of it is in view, from the true state and its estimate at the exposure."""
        p_WC, R_WC = mount.pose(true.p_WB, so3.quat_to_matrix(true.q_WB))
        points = self._cable.centre + np.linspace(-1.0, 1.0, 41)[:, None] * self._cable.half_length * self._cable.direction
        pixels, valid = mount.camera.project((points - p_WC) @ R_WC)
        if not np.any(valid & mount.camera.contains(pixels)):
            return
        view = self._cable.closest_point(p_WC) - p_WC
        distance = float(np.linalg.norm(view))
        view = view / distance
        across = np.cross(view, self._cable.direction)
        sigmas = np.array([DEPTH_ERROR, ACROSS_ERROR]) * distance + LEAST_ERROR
        axes = np.stack([view, across])
        self.moved = body.p_WB - body.corrected - true.p_WB + (sigmas * self._place) @ axes
        self._covariance = axes.T @ np.diag(sigmas**2) @ axes

    def mapped(self, body: BodyState) -> MappedPowerline:
        """Return the cable as mapped, in the odometry's W of a state."""
        assert self.moved is not None  # it was seen
        line = replace(self._cable, centre=self._cable.centre + self.moved + body.corrected, direction=self._direction)
        start, end = (tuple(place.tolist()) for place in line.ends)
        return MappedPowerline(line.id, start, end, line.radius, self._covariance, DIRECTION_ERROR, 100)
