"""Where target poses come from: corners with the measured error of the tag pipeline, or the pipeline on rendered images.

The error model replaces the image, not the localiser: the board's corners are projected with the *true* camera (its
calibration errors included), shaken by the error that `perch_perception.tags` makes on rendered images (0.06 px
at 1.7 m, 0.18 px at 3 m), and solved with the nominal camera by the code that flies. What it does not model:
blur, contrast and light.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from perch_core.camera import CameraMount
from perch_core.covariance import largest_sigma
from perch_core.surface import PerchSurface
from perch_core.tag_board import TagBoard
from perch_perception.pose_buffer import BodyState, StampError
from perch_perception.tags import BoardLocalizer, Localization, LocalizationRefusal, average_board, fuse, solve_board, start_fusion, to_map
from perch_perception.target_localizer_node import TargetLocalizerConfig
from perch_control.mission import Target
from perch_core import so3
from perch_eval.in_process.frame_source import FrameSource
from perch_eval.in_process.stamps import published
from perch_sim.camera_stream import Delivery
from perch_sim.state_history import StateHistory, TrueState

READABLE_SIDE = 12.5    # a tag whose shortest side is smaller is not found [px]: 0.16 m at 3.5 m
_SIDE, _SIGMA = 25.9, 0.06                              # shortest side of a tag [px] and its corners' error there [px]
_GROWTH = np.log(0.18 / 0.06) / np.log(3.0 / 1.7)       # exponent with which that grows as the side shrinks
_LARGEST = 0.6                                          # [px]


def corner_sigma(side: np.ndarray) -> np.ndarray:
    """1 sigma of a measured corner along each image axis, for the tag's shortest side [px]."""
    return np.clip(_SIGMA * (_SIDE / np.maximum(side, 1.0)) ** _GROWTH, 0.05, _LARGEST)


class ModelledSight:
    """Sightings of the board made from the truth."""

    def __init__(self, board: TagBoard, mount: CameraMount, true: CameraMount, params: TargetLocalizerConfig,
                 rng: np.random.Generator, truth: StateHistory, pad: Callable[[], PerchSurface]) -> None:
        """
        Args:
            board: geometry of the tags.
            mount: the camera as calibrated.
            true: the camera as it is.
            params: of the node.
            rng: of the corners' errors.
            truth: the vehicle's last states.
            pad: gives the true pad as it is now.
        """
        self._truth, self._pad = truth, pad
        self._board, self._mount, self._true, self._params, self._rng = board, mount, true, params, rng
        self._last = self._searched = -np.inf
        self._R_CS: np.ndarray | None = None

    def see(self, delivery: Delivery, exposed: float, body: BodyState | None) -> Localization:
        """What the localiser would say of a frame."""
        settings = self._params.localizer
        tracking = exposed - self._last <= settings.lost_after
        if not tracking:
            self._R_CS = None
            if exposed - self._searched < 1.0 / settings.search_rate - 1e-3:
                return Localization(None, message="waiting for the next search")
            self._searched = exposed
        pixels, ids, side = self._visible(self._truth.at(delivery.frame.middle), self._pad())
        if not ids:
            return Localization(None, message="no tag of the board found")
        sigma = np.repeat(corner_sigma(side)[:, None], 4, axis=1)
        measured = pixels + sigma[..., None] * self._rng.standard_normal(pixels.shape)
        rays = self._mount.camera.unproject(measured.reshape(-1, 2)).reshape(-1, 4, 3)
        corners_S = self._board.corners_S[[self._board.ids.index(i) for i in ids]]
        try:
            pose = solve_board(self._mount.camera, corners_S, rays, sigma, ids, self._R_CS, lens_sigma=self._params.calibration.lens)
        except LocalizationRefusal as refusal:
            return Localization(None, message=str(refusal))
        if not settings.min_range <= np.linalg.norm(pose.p_CS) <= settings.max_range:
            return Localization(None, message="not a board of this size")
        self._last, self._R_CS = exposed, pose.R_CS
        complete = len(ids) == len(self._board.ids)
        average = None
        if self._params.mode == "average" and complete:
            average = average_board(self._mount.camera, corners_S, rays, ids)
        return Localization(pose, average, complete)

    def _visible(self, state: TrueState, pad: PerchSurface) -> tuple[np.ndarray, tuple[int, ...], np.ndarray]:
        """True pixels (n, 4, 2), numbers and shortest sides (n,) of the tags that can be read."""
        p_WC, R_WC = self._true.pose(state.p_WB, so3.quat_to_matrix(state.q_WB))
        if (p_WC - pad.p_WS) @ pad.normal <= 0.05:
            return np.zeros((0, 4, 2)), (), np.zeros(0)
        corners_W = pad.p_WS + self._board.corners_S @ pad.R_WS.T
        pixels, valid = self._true.camera.project(((corners_W - p_WC) @ R_WC).reshape(-1, 3))
        inside = (valid & self._true.camera.contains(pixels, margin=1.0)).reshape(-1, 4).all(axis=1)
        pixels = pixels.reshape(-1, 4, 2)
        side = np.linalg.norm(np.roll(pixels, -1, axis=1) - pixels, axis=2).min(axis=1)
        keep = inside & (side >= READABLE_SIDE)
        return pixels[keep], tuple(np.array(self._board.ids)[keep].tolist()), side[keep]


class RenderedSight:
    """Sightings by the tag pipeline on rendered images."""

    def __init__(self, board: TagBoard, mount: CameraMount, params: TargetLocalizerConfig) -> None:
        self._localizer = BoardLocalizer(board, mount, params.localizer, averaging=params.mode == "average", calibration=params.calibration)

    def see(self, delivery: Delivery, exposed: float, body: BodyState | None) -> Localization:
        """What the localiser says of a frame."""
        return self._localizer.process(delivery.image.result, exposed, body)


class TargetSource(FrameSource):
    """Mirrors `perch_perception.target_localizer_node`."""

    def __init__(self, sight: ModelledSight | RenderedSight, mount: CameraMount, params: TargetLocalizerConfig) -> None:
        super().__init__(mount)
        self._sight, self._params = sight, params
        self._target = None

    def answer(self, delivery: Delivery) -> Target | None:
        """The target as published for one frame; None where nothing is."""
        exposed = self.exposed(delivery)
        if not self.fresh(exposed):
            return None
        try:
            body = self._buffer.at(exposed)
        except StampError:
            body = None
        result = self._sight.see(delivery, exposed, body)
        if result.board is None or body is None:
            return None
        return self._update(result, body, exposed)

    def _update(self, result: Localization, body: BodyState, exposed: float) -> Target | None:
        measured = to_map(result.average or result.board, body, self._mount, self._params.calibration)
        fresh = True
        if self._params.mode == "fused":
            if self._target is not None:
                self._target = fuse(self._target, measured)
            elif self._good(measured.covariance):
                self._target = start_fusion(measured)
        elif self._params.mode == "average":
            fresh = self._target is None and result.average is not None
            if fresh:
                self._target = measured
        else:
            self._target = measured
        target = self._target if self._target is not None else measured
        return _as_received(target, exposed) if fresh and self._good(target.covariance) else None

    def _good(self, covariance: np.ndarray) -> bool:
        position, attitude = sigmas(covariance)
        return position <= self._params.max_position_sigma and attitude <= np.radians(self._params.max_attitude_sigma)


def sigmas(covariance: np.ndarray) -> tuple[float, float]:
    """Largest 1 sigma of position [m] and attitude [rad] of a pose covariance, shape (6, 6)."""
    return largest_sigma(covariance[:3, :3]), largest_sigma(covariance[3:, 3:])


def _as_received(target, exposed: float) -> Target:
    q = so3.quat_from_matrix(target.R_WS)
    return Target(published(exposed), np.asarray(target.p_WS, float), q / np.linalg.norm(q), *sigmas(target.covariance))
