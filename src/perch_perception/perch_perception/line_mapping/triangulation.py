"""A wire in space from its sightings along a path.

Each sighting gives a plane through the camera's centre that contains the wire: n . d = 0 and n . (p - c) = 0. Their
intersection is the start; a robust least-squares fit to all rays, with the poses' own errors, refines it and says how
well it is known. Where the camera moved along the wire or towards it, all planes are the same plane, and the depth
would be off by metres: such baselines are refused.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Sequence

import numpy as np

from perch_core import config
from perch_core.errors import PerchError
from perch_perception.line_mapping.curve import PARAMETERS, WireCurve
from perch_perception.line_mapping.observation import LineObservation

ITERATIONS = 6
WARM_ITERATIONS = 2    # where an earlier result is near; the next sighting brings the next two
HUBER = 2.5            # residuals beyond this many sigma count linearly


@dataclass(frozen=True)
class TriangulationConfig:
    """What the images and poses are worth, and what baseline is enough."""

    min_ratio: float = config.quantity(0.03, above=0.0, high=0.5,
                                       doc="least sigma2/sigma1 of the planes' normals; below it the depth is not determined")
    pose_position: float = config.quantity(0.003, unit="m", above=0.0, high=1.0,
                                           doc="error of the camera's position from image to image, 1 sigma")
    pose_drift: float = config.quantity(0.01, unit="m/sqrt(s)", low=0.0, high=1.0,
                                        doc="growth of that error with the age of a sighting; the wire is where the newest see it")
    pose_rotation: float = config.quantity(0.1, unit="deg", above=0.0, high=10.0, doc="the same for its attitude")
    sag: float = config.quantity(0.03, unit="1/m", above=0.0, high=1.0,
                                 doc="prior 1 sigma of a wire's curvature (0.02 is 16 cm of sag in a span of 8 m)")


class DegenerateBaseline(PerchError):
    """The camera's motion does not determine the wire. `ratio` is sigma2/sigma1 of the planes' normals."""

    def __init__(self, ratio: float, needed: float) -> None:
        self.ratio = ratio
        super().__init__(f"baseline ratio {ratio:.3f} < {needed:g}: move across the wire, not along it or towards it")


@dataclass(frozen=True)
class WireEstimate:
    """A triangulated wire.

    Attributes:
        curve: the wire in W.
        covariance: of its five parameters (see `WireCurve.moved`), shape (5, 5).
        ratio: sigma2/sigma1 of the baseline.
        used: sightings that agree with it, shape (n,).
    """

    curve: WireCurve
    covariance: np.ndarray
    ratio: float
    used: np.ndarray

    def point_covariance(self, s: float) -> np.ndarray:
        """Covariance of the point at s in W [m^2], shape (3, 3); across the wire only."""
        axes = self.curve.axes
        by_parameters = np.zeros((3, PARAMETERS))
        by_parameters[:, 0:2] = axes[:, :2]
        by_parameters[:, 2:4] = s * axes[:, :2]
        by_parameters[:, 4] = 0.5 * s * s * axes[:, 1]
        return by_parameters @ self.covariance @ by_parameters.T


def intersect_planes(observations: Sequence[LineObservation], settings: TriangulationConfig) -> tuple[WireCurve, float]:
    """The straight line that all planes share, and sigma2/sigma1 of their normals.

    Raises:
        DegenerateBaseline: fewer than two sightings, or planes that are nearly the same.
    """
    if len(observations) < 2:
        raise DegenerateBaseline(0.0, settings.min_ratio)
    normals = np.array([o.normal for o in observations])
    centres = np.array([o.p_WC for o in observations])
    _, sizes, axes = np.linalg.svd(normals)
    ratio = float(sizes[1] / sizes[0])
    if ratio < settings.min_ratio:
        raise DegenerateBaseline(ratio, settings.min_ratio)
    direction = axes[2]
    # the point of the line beside the last sighting's middle: a useful origin for s
    rows = np.concatenate([normals, direction[None]])
    values = np.concatenate([np.sum(normals * centres, axis=1), [direction @ centres.mean(axis=0)]])
    point = np.linalg.lstsq(rows, values, rcond=None)[0]
    line = WireCurve(point, direction)
    s = float(line.nearest(observations[-1].p_WC[None], observations[-1].middle[None])[0])
    return WireCurve(line.at(s), direction), ratio


def triangulate(observations: Sequence[LineObservation], settings: TriangulationConfig,
                start: WireCurve | None = None) -> WireEstimate:
    """The wire that the sightings share.

    Args:
        observations: sightings of one wire.
        settings: noise and limits.
        start: an earlier result; its point keeps the origin of s where it is.

    Raises:
        DegenerateBaseline: the camera's motion does not determine the wire, or puts it behind the camera.
    """
    line, ratio = intersect_planes(observations, settings)
    curve = start if start is not None else line
    centres = np.repeat([o.p_WC for o in observations], len(observations[0].rays_W), axis=0)
    rays = np.concatenate([o.rays_W for o in observations])
    used = np.ones(len(observations), bool)
    for _ in range(ITERATIONS if start is None else WARM_ITERATIONS):
        residual, jacobian = _whitened(curve, observations, centres, rays, settings)
        size = np.sqrt(np.mean(residual**2, axis=1))  # (n,), 1 where all is as expected
        used = size < 3.0 * max(1.0, float(np.median(size)))
        weight = np.where(used, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)), 0.0)
        information = np.einsum("n,nki,nkj->ij", weight, jacobian, jacobian)
        information[4, 4] += 1.0 / settings.sag**2
        gradient = np.einsum("n,nki,nk->i", weight, jacobian, residual)
        gradient[4] += curve.curvature / settings.sag**2
        step = -np.linalg.solve(information, gradient)
        step[:4] *= min(1.0, 0.5 / max(np.abs(step[:4]).max(), 1e-12))
        curve = curve.moved(step)
        if np.abs(step).max() < 1e-4:
            break
    if np.mean(curve.offsets(centres, rays).ahead > 0) < 0.9 or not np.all(np.isfinite(curve.point)):
        raise DegenerateBaseline(ratio, settings.min_ratio)
    covariance = np.linalg.inv(information) * max(1.0, float(np.mean(size[used] ** 2)))
    return WireEstimate(curve, covariance, ratio, used)


def _whitened(curve, observations, centres, rays, settings):
    """Residuals (n, k) in sigmas and their Jacobian (n, k, 5), decorrelated within each image.

    All rays of one image share its pose error: n . (dtheta x r) and n . (d x dc) / distance move them together. The
    odometry drifts: of two sightings that disagree the newer is right, as what is flown next starts from the newest pose.
    """
    n, k = len(observations), len(observations[0].rays_W)
    against = curve.offsets(centres, rays)
    by_rotation = np.cross(rays, against.normals)  # n . (dtheta x r)
    # a centre moved by dc sees the wire's point moved by -dc: across the plane by n . dc / distance
    by_position = against.normals / np.maximum(against.ahead, 0.1)[:, None]
    age = observations[-1].time - np.array([o.time for o in observations])
    position = np.repeat(np.sqrt(settings.pose_position**2 + settings.pose_drift**2 * np.maximum(age, 0.0)), k)
    by_pose = np.concatenate([by_rotation * np.radians(settings.pose_rotation), by_position * position[:, None]],
                             axis=1).reshape(n, k, 6)
    sigma = np.array([o.sigma for o in observations])
    covariance = by_pose @ np.swapaxes(by_pose, 1, 2) + sigma[:, None, None] ** 2 * np.eye(k)
    root = np.linalg.cholesky(covariance)
    both = np.linalg.solve(root, np.concatenate([against.angles.reshape(n, k, 1),
                                                 against.jacobian.reshape(n, k, PARAMETERS)], axis=2))
    return both[..., 0], both[..., 1:]
