"""A wire in space from its sightings along a path.

Each sighting gives a plane through the camera's centre that contains the wire: n . d = 0 and n . (p - c) = 0. Their
intersection is the start; a robust least-squares fit to all rays, with the poses' own errors, refines it and says how
well it is known. The odometry drifts as it flies: in its frame the wire wanders, and is estimated where it is now. Where the camera moved along the wire or towards it, all planes are the same plane, and the depth
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

RIGID_ITERATIONS = 6   # first fit, as if the odometry did not drift: it shows which sightings do not belong to the wire
ITERATIONS = 2         # from there, or from an earlier result; the next sighting brings the next two
HUBER = 2.5            # residuals beyond this many sigma count linearly


@dataclass(frozen=True)
class TriangulationConfig:
    """What the images and poses are worth, and what baseline is enough."""

    min_ratio: float = config.quantity(0.03, above=0.0, high=0.5,
                                       doc="least sigma2/sigma1 of the planes' normals; below it the depth is not determined")
    pose_position: float = config.quantity(0.006, unit="m", above=0.0, high=1.0,
                                           doc="error of the camera's position from image to image, 1 sigma")
    pose_drift: float = config.quantity(0.01, unit="m/sqrt(s)", low=0.0, high=1.0,
                                        doc="random walk of the odometry; the wire is where the newest sightings see it")
    pose_rotation: float = config.quantity(0.1, unit="deg", above=0.0, high=10.0, doc="the same for its attitude")
    mount_rotation: float = config.quantity(0.3, unit="deg", above=0.0, high=10.0,
                                            doc="error of the camera's attitude on the body, per axis, 1 sigma: the same in all sightings")
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
        mount: error of the camera's attitude on the body that fits them best, in C [rad], shape (3,).
    """

    curve: WireCurve
    covariance: np.ndarray
    ratio: float
    used: np.ndarray
    mount: np.ndarray

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
                before: WireEstimate | None = None) -> WireEstimate:
    """The wire that the sightings share.

    Args:
        observations: sightings of one wire.
        settings: noise and limits.
        before: an earlier result; its point keeps the origin of s where it is.

    Raises:
        DegenerateBaseline: the camera's motion does not determine the wire, or puts it behind the camera.
    """
    line, ratio = intersect_planes(observations, settings)
    curve, mount = (line, np.zeros(3)) if before is None else (before.curve, before.mount)
    centres = np.repeat([o.p_WC for o in observations], len(observations[0].rays_W), axis=0)
    rays = np.concatenate([o.rays_W for o in observations])
    used = np.ones(len(observations), bool)
    times = np.array([o.time for o in observations])
    drifted = settings.pose_drift**2 * np.maximum(np.diff(times, prepend=times[0]), 0.0)  # variance added before each sighting
    rigid, rounds = np.zeros(len(times)), RIGID_ITERATIONS if before is None else 0
    for walk in [rigid] * rounds + [drifted] * ITERATIONS:
        residual, _ = _whitened(curve, mount, observations, centres, rays, settings, walk.sum() - np.cumsum(walk))
        size = np.sqrt(np.mean(residual**2, axis=1))  # (n,), 1 where all is as expected
        used = size < 3.0 * max(1.0, float(np.median(size)))
        weight = np.where(used, np.minimum(1.0, HUBER / np.maximum(size, 1e-9)), 0.0)
        information, gradient = _wandering(*_whitened(curve, mount, observations, centres, rays, settings, rigid), weight, walk, settings,
                                           curve.curvature, mount)
        step = -np.linalg.solve(information, gradient)
        step[:4] *= min(1.0, 0.5 / max(np.abs(step[:4]).max(), 1e-12))
        curve, mount = curve.moved(step[:PARAMETERS]), mount + step[PARAMETERS:]
    if np.mean(curve.offsets(centres, rays).ahead > 0) < 0.9 or not np.all(np.isfinite(curve.point)):
        raise DegenerateBaseline(ratio, settings.min_ratio)
    covariance = np.linalg.inv(information)[:PARAMETERS, :PARAMETERS] * max(1.0, float(np.mean(size[used] ** 2)))
    return WireEstimate(curve, covariance, ratio, used, mount)


def _wandering(residual, jacobian, weight, walk, settings, curvature, mount):
    """Information (8, 8) and gradient (8,) of the wire where it is after the last sighting, and of the camera's mount.

    A filter in information form from the oldest sighting to the newest: before each, the wire's two offsets lose what the
    odometry's random walk takes, W = walk G G', so that I <- (I^-1 + W)^-1. All sightings from before a drift share it:
    together they know the wire's place no better than that, however many they are.
    """
    parts = np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian)
    slopes = np.einsum("n,nki,nk->ni", weight, jacobian, residual)
    tight = np.concatenate([np.zeros(4), [1.0 / settings.sag**2], np.full(3, 1.0 / np.radians(settings.mount_rotation) ** 2)])
    information, gradient = np.diag(tight), tight * np.concatenate([np.zeros(4), [curvature], mount])
    for part, slope, variance in zip(parts, slopes, walk):
        if variance > 0.0:
            a, b, c = information[0, 0] + 1.0 / variance, information[1, 1] + 1.0 / variance, information[0, 1]
            lost = information[:, :2] @ (np.array([[b, -c], [-c, a]]) / (a * b - c * c))
            gradient = gradient - lost @ gradient[:2]
            information = information - lost @ information[:2]
        information, gradient = information + part, gradient + slope
    return information, gradient


def _whitened(curve, mount, observations, centres, rays, settings, walk):
    """Residuals (n, k) in sigmas and their Jacobian (n, k, 8) by wire and mount, decorrelated within each image.

    All rays of one image share its pose error: n . (dtheta x r) and n . (d x dc) / distance move them together. `walk` (n,)
    is added to the variance of the positions [m^2].
    """
    n, k = len(observations), len(observations[0].rays_W)
    against = curve.offsets(centres, rays)
    by_rotation = np.cross(rays, against.normals)  # n . (dtheta x r)
    # a centre moved by dc sees the wire's point moved by -dc: across the plane by n . dc / distance
    by_position = against.normals / np.maximum(against.ahead, 0.1)[:, None]
    position = np.repeat(np.sqrt(settings.pose_position**2 + walk), k)
    by_pose = np.concatenate([by_rotation * np.radians(settings.pose_rotation), by_position * position[:, None]],
                             axis=1).reshape(n, k, 6)
    sigma = np.array([o.sigma for o in observations])
    covariance = by_pose @ np.swapaxes(by_pose, 1, 2) + sigma[:, None, None] ** 2 * np.eye(k)
    root = np.linalg.cholesky(covariance)
    by_mount = by_rotation.reshape(n, k, 3) @ np.array([o.R_WC for o in observations])
    both = np.linalg.solve(root, np.concatenate([against.angles.reshape(n, k, 1) + by_mount @ mount[:, None],
                                                 against.jacobian.reshape(n, k, PARAMETERS), by_mount], axis=2))
    return both[..., 0], both[..., 1:]
