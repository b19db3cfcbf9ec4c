"""Node `target_localizer`: images of the front camera in, the pose of the perching target in `map` out. [M:sec. IV-B]"""

from __future__ import annotations

import time
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovariance, PoseWithCovarianceStamped
from perch_core import config, so3
from perch_core.covariance import largest_sigma
from perch_core.ros.conversions import to_pose, to_stamp
from perch_core.ros.node import spin_main
from perch_core.tag_board import load_board
from perch_msgs.msg import TargetDetection
from sensor_msgs.msg import Image

from perch_perception.images import ImageError, mono_image
from perch_perception.pose_buffer import BodyState, StampError
from perch_perception.ros.camera_node import CameraNode
from perch_perception.tags import (BoardLocalizer, BoardPose, CalibrationSigma, FusedTarget, Localization, LocalizerConfig,
                                   MapPose, fuse, start_fusion, to_map)

DIAGNOSTICS_PERIOD = 1.0  # [s]
FRAME = "map"


@dataclass(frozen=True)
class TargetLocalizerConfig:
    """Parameters of the node."""

    vehicle: str = config.text("snapdragon", doc="vehicle whose camera it is, config/vehicles/<name>.yaml")
    camera: str = config.text("front", doc="camera of the vehicle; its images are on camera_<name>/image_raw")
    board: str = config.text("pad_four_tags", doc="tag board, config/boards/<name>.yaml")
    mode: str = config.choice("joint", options=("joint", "average", "fused"),
                              doc="joint: latest image, all corners together; average: the paper's mean over the tags of "
                                  "the first complete image; fused: all images")
    max_position_sigma: float = config.quantity(0.10, unit="m", above=0.0, high=10.0,
                                                doc="worst axis with which target/pose is still published")
    max_attitude_sigma: float = config.quantity(5.0, unit="deg", above=0.0, high=180.0, doc="the same for the attitude")
    localizer: LocalizerConfig = config.part(LocalizerConfig)
    calibration: CalibrationSigma = config.part(CalibrationSigma)


class TargetLocalizerNode(CameraNode[TargetLocalizerConfig]):
    """Publishes `target/detections` for every image and `target/pose` whenever the target is known well enough."""

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("target_localizer", TargetLocalizerConfig, **kwargs)
        board = load_board(self.params.board)
        self._localizer = BoardLocalizer(board, self._mount, self.params.localizer,
                                         averaging=self.params.mode == "average", calibration=self.params.calibration)
        self._target: FusedTarget | MapPose | None = None
        self._costs: deque[float] = deque(maxlen=300)
        self._counts = {"images": 0, "found": 0, "complete": 0}
        self._message, self._diagnosed = "", -np.inf
        self._detections = self._participant.publisher(TargetDetection, "target/detections")
        self._poses = self._participant.publisher(PoseWithCovarianceStamped, "target/pose")
        self.begin()

    def use(self, msg: Image, exposed: float, refusal: str) -> None:
        """Localise the board in one image, publish, and report."""
        begin = time.perf_counter()
        body, problem = None, ""
        try:
            body = self._buffer.at(exposed)
        except StampError as error:
            problem = str(error)
        result = Localization(None, message=refusal)
        if not refusal:
            try:
                result = self._localizer.process(mono_image(msg, self._mount.camera), exposed, body)
            except ImageError as error:
                result = Localization(None, message=str(error))
        self._publish(result, body, exposed, problem)
        self._costs.append(time.perf_counter() - begin)
        self._participant.report(msg.header.stamp)
        if exposed - self._diagnosed >= DIAGNOSTICS_PERIOD:
            self._diagnosed = exposed
            self._publish_diagnostics(exposed)

    def _publish(self, result: Localization, body: BodyState | None, exposed: float, problem: str) -> None:
        detection = TargetDetection(method=self.params.mode)
        detection.header.stamp, detection.header.frame_id = to_stamp(float(exposed)), FRAME
        board = result.board
        self._counts["images"] += 1
        if board is not None:
            self._counts["complete"] += result.complete
            shown = result.average or board
            detection.ids = [int(i) for i in shown.ids]
            detection.reprojection_rms = float(shown.rms)
            detection.pose_camera = pose_message(shown.p_CS, shown.R_CS, shown.covariance)
            if body is not None:
                self._counts["found"] += 1
                self._update(board, result, body, detection)
        detection.message = "; ".join(part for part in (result.message, problem if board is not None else "") if part)
        self._message = detection.message
        self._detections.publish(detection)

    def _update(self, board: BoardPose, result: Localization, body: BodyState, detection: TargetDetection) -> None:
        """Bring the target up to date by the mode, and publish it where it is good enough."""
        measured = to_map(result.average or board, body, self._mount, self.params.calibration)
        fresh, detection.frames_fused = True, 1
        if self.params.mode == "fused":
            self._fuse(measured)
            detection.frames_fused = self._target.frames if self._target is not None else 1
        elif self.params.mode == "average":
            fresh = self._target is None and result.average is not None  # the first complete image, once
            if fresh:
                self._target = measured
            elif self._target is None:
                detection.method = "joint"  # not all tags yet: this is no average
        else:
            self._target = measured
        target = self._target if self._target is not None else measured
        detection.found = True
        detection.pose = pose_message(target.p_WS, target.R_WS, target.covariance)
        if fresh and self._good(target.covariance):
            out = PoseWithCovarianceStamped(pose=detection.pose)
            out.header = detection.header
            self._poses.publish(out)

    def _fuse(self, measured: MapPose) -> None:
        if self._target is not None:
            self._target = fuse(self._target, measured)
        elif self._good(measured.covariance):  # not before the estimator knows where it is
            self._target = start_fusion(measured)

    def _good(self, covariance: np.ndarray) -> bool:
        """Whether the worst axes of position and attitude are known within the limits."""
        position, attitude = largest_sigma(covariance[:3, :3]), largest_sigma(covariance[3:, 3:])
        return bool(position <= self.params.max_position_sigma and attitude <= np.radians(self.params.max_attitude_sigma))

    def _publish_diagnostics(self, now: float) -> None:
        costs = 1e3 * np.array(self._costs)
        values = {**self._counts, "cost_ms_median": float(np.median(costs)), "cost_ms_p99": float(np.percentile(costs, 99)),
                  "dropped": self._pending.dropped, "mode": self.params.mode}
        self.publish_diagnostics(now, values, 0 if not self._message else 1, self._message or "ok")


def pose_message(p: np.ndarray, R: np.ndarray, covariance: np.ndarray) -> PoseWithCovariance:
    """Pose, shapes (3,) and (3, 3), and covariance (6, 6) of its errors in the axes of the parent frame, as a message."""
    msg = PoseWithCovariance(pose=to_pose(p, so3.quat_from_matrix(R)))
    msg.covariance = np.ascontiguousarray(covariance, dtype=float).ravel()
    return msg


def create(**kwargs: Any) -> TargetLocalizerNode:
    """The node, for its own process or a composed one."""
    return TargetLocalizerNode(**kwargs)


def main() -> None:
    """Entry point of the executable `target_localizer`."""
    spin_main(create)
