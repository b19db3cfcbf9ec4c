"""Triangulation of a wire from its sightings along a path.

Each sighting gives a plane through the camera's centre that contains the wire: n . d = 0 and n . (p - c) = 0. Their
intersection is the initial guess; a robust least-squares fit to all rays, with the poses' own errors, refines it and gives its
covariance. As the odometry drifts, the wire moves in its frame: the wire's place at the last sighting is estimated. Where the
camera moved along the wire or towards it, all planes coincide, and the depth would be off by metres: such baselines are refused.

A wire has one radius, and appears wider the nearer it is: sin(width / 2) = radius / distance. Far from the wire, triangulation
gives the distance, and so the radius; near it, where the camera flies towards the wire, the radius gives the distance.
"""

from __future__ import annotations

from dataclasses import dataclass
from collections.abc import Sequence

import numpy as np

from perch_core import config
from perch_core.errors import PerchError
from perch_core.sensors import CalibrationSigmas
from perch_perception.line_mapping.curve import PARAMETERS, WireCurve
from perch_perception.line_mapping.observation import LineObservation

MIN_RATIO = 0.03   # least sigma2/sigma1 of the planes' normals; below it the depth is not determined
POSE_POSITION, POSE_ROTATION = 0.006, np.radians(0.1)  # 1 sigma of the camera's pose from image to image [m, rad]
_EXACT = 1e-6      # 1 sigma of a mount that is known exactly, for a regular information matrix [rad]
SAG = 0.03         # prior 1 sigma of a wire's curvature (0.02 is 16 cm of sag in a span of 8 m) [1/m]
WIDTH_ERROR = 0.01      # error of a wire's width in an image, beside that of its edges: share of it
WIDTH_EDGE_ERROR = 0.3  # error of a wire's edges in an image beside that of its rays: share of it
RIGID_ITERATIONS = 6   # first fit, as if the odometry did not drift: it shows which sightings do not belong to the wire
ITERATIONS = 2         # from there, or from an earlier result; the next sighting brings the next two
HUBER = 2.5            # residuals beyond this many sigma count linearly
MAX_PRIOR_SIGMA = 0.05  # an earlier result that is less certain is not used as a prior [m]
GATE = 4.0             # widths farther off than so many sigma are not this wire's
WIDTH_GATE = 0.08      # error of the distance, 1 sigma, before there is an earlier result [m]
UNKNOWNS = PARAMETERS + 4  # the wire, the camera's mount, the logarithm of the radius


@dataclass(frozen=True)
class TriangulationConfig:
    """Uncertainty of the poses, and prior knowledge of the wires."""

    pose_drift: float = config.quantity(0.01, unit="m/sqrt(s)", low=0.0, high=1.0,
                                        doc="random walk of the odometry; the wire is where the newest sightings see it")
    pose_drift_moved: float = config.quantity(0.01, unit="m/sqrt(m)", low=0.0, high=1.0, doc="the same over the distance moved")
    mount_rotation: float = config.derived(CalibrationSigmas().rotation)  # 1 sigma of the camera's attitude on the body, per axis [rad]
    radius: float = config.quantity(0.03, unit="m", above=0.0, high=0.5,
                                    doc="radius of a wire that is too thin to be measured")


class Undetermined(PerchError):
    """Raised when the sightings do not determine a wire; the message gives the reason."""


@dataclass(frozen=True)
class WireEstimate:
    """A triangulated wire.

    Attributes:
        curve: the wire in W.
        covariance: of its five parameters (see `WireCurve.moved`), shape (5, 5).
        used: sightings that agree with it, shape (n,).
        mount: estimated error of the camera's attitude on the body, in C [rad], shape (3,).
        radius: of the wire [m]; nan where its width was never measured.
        time: of the last sighting, for which `curve` is valid [s].
    """

    curve: WireCurve
    covariance: np.ndarray
    used: np.ndarray
    mount: np.ndarray
    radius: float
    time: float = 0.0

    def width_from(self, p_WC: np.ndarray) -> float:
        """Return the wire's angular width from a place (3,) [rad]; nan where its radius is not known."""
        to = self.curve.point - p_WC
        distance = float(np.linalg.norm(to - (to @ self.curve.direction) * self.curve.direction))
        return float(2.0 * np.arcsin(min(self.radius / max(distance, 1e-3), 1.0)))

    def point_covariance(self, s: float) -> np.ndarray:
        """Return the covariance of the point at s in W [m^2], shape (3, 3); across the wire only."""
        axes = self.curve.axes
        by_parameters = np.zeros((3, PARAMETERS))
        by_parameters[:, 0:2] = axes[:, :2]
        by_parameters[:, 2:4] = s * axes[:, :2]
        by_parameters[:, 4] = 0.5 * s * s * axes[:, 1]
        return by_parameters @ self.covariance @ by_parameters.T


def intersect_planes(observations: Sequence[LineObservation]) -> WireCurve:
    """Return the straight line that all planes share.

    Raises:
        Undetermined: fewer than two sightings, or planes that are nearly the same.
    """
    if len(observations) < 2:
        raise Undetermined("only one sighting")
    normals = np.array([o.normal for o in observations])
    centres = np.array([o.p_WC for o in observations])
    _, sizes, axes = np.linalg.svd(normals)
    ratio = float(sizes[1] / sizes[0])
    if ratio < MIN_RATIO:
        raise Undetermined(f"baseline ratio {ratio:.3f} < {MIN_RATIO:g}: move across the wire, not along it or towards it")
    direction = axes[2]
    # the point of the line beside the last sighting's middle: a useful origin for s
    rows = np.concatenate([normals, direction[None]])
    values = np.concatenate([np.sum(normals * centres, axis=1), [direction @ centres.mean(axis=0)]])
    point = np.linalg.lstsq(rows, values, rcond=None)[0]
    line = WireCurve(point, direction)
    s = float(line.nearest(observations[-1].p_WC[None], observations[-1].middle[None])[0])
    return WireCurve(line.at(s), direction)


def triangulate(observations: Sequence[LineObservation], settings: TriangulationConfig,
                before: WireEstimate | None = None) -> WireEstimate:
    """Triangulate a wire from its sightings.

    Args:
        observations: sightings of one wire.
        settings: uncertainty of the poses, and prior knowledge of the wires.
        before: an earlier result; its point keeps the origin of s where it is.

    Raises:
        Undetermined: the motion does not determine the wire, it would be behind the camera, or the sightings are of several.
    """
    line = intersect_planes(observations)
    curve, mount = (line, np.zeros(3)) if before is None else (before.curve, before.mount)
    centres = np.repeat([o.p_WC for o in observations], len(observations[0].rays_W), axis=0)
    rays = np.concatenate([o.rays_W for o in observations])
    # the median of all widths anew: those of crossing wires may have come first
    size = _log_radius(curve, observations)
    used = np.ones(len(observations), bool)
    drifted = _drifted(observations, settings)
    rigid, rounds = np.zeros(len(used)), RIGID_ITERATIONS if before is None else 0
    known, newest = _prior_of(observations, before)
    if known > MAX_PRIOR_SIGMA**2:  # it would take whatever comes
        known, newest = 0.0, -1
    for number, walk in enumerate([rigid] * rounds + [drifted] * ITERATIONS):
        walked = np.cumsum(walk)
        # an earlier result is where the wire was at its own last sighting: what came since may be off by the walk and by its error
        apart = np.abs(walked[newest if number == rounds else -1] - walked) + known
        residual, _ = _whitened(curve, mount, observations, centres, rays, apart)
        widths, one_wire = _widths(curve, size, observations, apart if known > 0.0 else apart + WIDTH_GATE**2)
        misfit = np.sqrt(np.mean(residual**2, axis=1))  # (n,), 1 where all is as expected
        used = one_wire & (misfit < 3.0 * max(1.0, float(np.median(misfit))))
        weight = np.where(used, np.minimum(1.0, HUBER / np.maximum(misfit, 1e-9)), 0.0)
        by_rays = _normal_equations(_whitened(curve, mount, observations, centres, rays, rigid), weight)
        by_widths = _normal_equations(widths, weight)
        information, gradient = _information_filter(by_rays, by_widths, walk, settings, curve.curvature, mount)
        try:
            step = -np.linalg.solve(information, gradient)
        except np.linalg.LinAlgError:  # the sightings that are left say nothing of one direction
            raise Undetermined("the viewpoints of the consistent sightings are too similar") from None
        step[:4] *= min(1.0, 0.5 / max(np.abs(step[:4]).max(), 1e-12))
        curve, mount, size = curve.moved(step[:PARAMETERS]), mount + step[PARAMETERS:-1], size + step[-1]
    if np.mean(curve.offsets(centres, rays).ahead > 0) < 0.9 or not np.all(np.isfinite(curve.point)):
        raise Undetermined("it would be behind the camera")
    if 2 * used.sum() <= len(used):
        raise Undetermined("its sightings are of several wires that meet in the image")
    covariance = np.linalg.inv(information)[:PARAMETERS, :PARAMETERS] * max(1.0, float(np.mean(misfit[used] ** 2)))
    return WireEstimate(curve, covariance, used, mount, float(np.exp(size)), observations[-1].time)


def _prior_of(observations: Sequence[LineObservation], before: WireEstimate | None) -> tuple[float, int]:
    """Return the variance of an earlier result's place [m^2], and the index of the last sighting that it includes."""
    if before is None:
        return 0.0, -1
    return (float(np.linalg.eigvalsh(before.covariance[:2, :2])[-1]),
            max((k for k, one in enumerate(observations) if one.time <= before.time), default=0))


def _drifted(observations: Sequence[LineObservation], settings: TriangulationConfig) -> np.ndarray:
    """Return the variance that the odometry's random walk adds before each sighting, shape (n,) [m^2]."""
    times, centres = np.array([o.time for o in observations]), np.array([o.p_WC for o in observations])
    waited = np.maximum(np.diff(times, prepend=times[0]), 0.0)
    moved = np.linalg.norm(np.diff(centres, axis=0, prepend=centres[:1]), axis=1)
    return settings.pose_drift**2 * waited + settings.pose_drift_moved**2 * moved


def _normal_equations(linear: tuple[np.ndarray, np.ndarray], weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return J' w J (n, 9, 9) and J' w r (n, 9) of every sighting, from its residuals r (n, k) and Jacobian J (n, k, 9)."""
    residual, jacobian = linear
    return np.einsum("n,nki,nkj->nij", weight, jacobian, jacobian), np.einsum("n,nki,nk->ni", weight, jacobian, residual)


def _information_filter(by_rays, by_widths, walk, settings, curvature, mount):
    """Return information (9, 9) and gradient (9,) of the wire after the last sighting, the camera's mount and the radius.

    An information filter runs from the oldest sighting to the newest. Before each, the odometry's random walk W = walk G G'
    reduces the information on the wire's two offsets: I <- (I^-1 + W)^-1. All sightings before a drift share its error: however
    many they are, they do not determine the wire's place any better.
    """
    parts, slopes = by_rays[0] + by_widths[0], by_rays[1] + by_widths[1]
    tight = np.concatenate([np.zeros(4), [1.0 / SAG**2], np.full(3, max(settings.mount_rotation, _EXACT)**-2), [1e-6]])  # of the radius nothing is known
    information, gradient = np.diag(tight), tight * np.concatenate([np.zeros(4), [curvature], mount, [0.0]])
    for part, slope, variance in zip(parts, slopes, walk):
        if variance > 0.0:
            a, b, c = information[0, 0] + 1.0 / variance, information[1, 1] + 1.0 / variance, information[0, 1]
            lost = information[:, :2] @ (np.array([[b, -c], [-c, a]]) / (a * b - c * c))
            gradient = gradient - lost @ gradient[:2]
            information = information - lost @ information[:2]
        information, gradient = information + part, gradient + slope
    return information, gradient


def _log_radius(curve, observations):
    """Return the median logarithm of the radius from the measured widths; nan without any."""
    seen = [o for o in observations if o.width > 0.0]
    if not seen:
        return float("nan")
    distance = np.linalg.norm(_feet(curve, seen)[0], axis=1)
    return float(np.median(np.log(np.sin([0.5 * o.width for o in seen]) * distance)))


def _feet(curve, observations):
    """Return the perpendicular vectors from the cameras to the wire, shape (n, 3) [m], and the s of their feet (n,)."""
    to = curve.point - np.array([o.p_WC for o in observations])
    s = -to @ curve.direction
    return to + s[:, None] * curve.direction + (0.5 * curve.curvature * s * s)[:, None] * curve.axes[:, 1], s


def _widths(curve, size, observations, apart):
    """Return residuals (n, 1) of log sin(width / 2) + log(distance) - log(radius) in sigmas, Jacobian (n, 1, 9), validity.

    A width whose distance differs by more than the variance `apart` (n,) [m^2] allows belongs to two wires that meet in the
    image, or to a part of one wire: its sighting's rays do not point to a wire's axis either.
    """
    residual, jacobian = np.zeros((len(observations), 1)), np.zeros((len(observations), 1, UNKNOWNS))
    one_wire = np.ones(len(observations), bool)
    width, ray = np.array([(o.width, o.sigma) for o in observations]).T
    seen = np.flatnonzero(width > 0.0)
    if not len(seen):
        return (residual, jacobian), one_wire
    width, ray = width[seen], ray[seen]
    to, s = _feet(curve, [observations[k] for k in seen])
    distance = np.maximum(np.linalg.norm(to, axis=1), 1e-3)
    misfit = np.log(np.sin(0.5 * width) * distance) - size
    sigma = np.sqrt(WIDTH_ERROR**2 + (WIDTH_EDGE_ERROR * ray / width) ** 2 + (POSE_POSITION / distance) ** 2)
    x, y = (to @ curve.axes[:, :2] / distance[:, None] ** 2).T
    zero = np.zeros_like(s)
    rows = np.stack([x, y, s * x, s * y, 0.5 * s * s * y, zero, zero, zero, zero - 1.0], axis=1) / sigma[:, None]
    one_wire[seen] = np.abs(misfit) < GATE * np.hypot(sigma, np.sqrt(apart[seen]) / distance)
    residual[seen, 0], jacobian[seen, 0] = misfit / sigma, rows
    return (residual, jacobian), one_wire


def _whitened(curve, mount, observations, centres, rays, walk):
    """Return residuals (n, k) in sigmas and their Jacobian (n, k, 9) by wire, mount and radius, decorrelated within each image.

    All rays of one image share its pose error: n . (dtheta x r) and n . (d x dc) / distance move them together. `walk` (n,)
    is added to the variance of the positions [m^2].
    """
    n, k = len(observations), len(observations[0].rays_W)
    against = curve.offsets(centres, rays)
    by_rotation = np.cross(rays, against.normals)  # n . (dtheta x r)
    # a centre moved by dc sees the wire's point moved by -dc: across the plane by n . dc / distance
    by_position = against.normals / np.maximum(against.ahead, 0.1)[:, None]
    position = np.repeat(np.sqrt(POSE_POSITION**2 + walk), k)
    by_pose = np.concatenate([by_rotation * POSE_ROTATION, by_position * position[:, None]], axis=1).reshape(n, k, 6)
    sigma = np.array([o.sigma for o in observations])
    covariance = by_pose @ np.swapaxes(by_pose, 1, 2) + sigma[:, None, None] ** 2 * np.eye(k)
    root = np.linalg.cholesky(covariance)
    by_mount = by_rotation.reshape(n, k, 3) @ np.array([o.R_WC for o in observations])
    both = np.linalg.solve(root, np.concatenate([against.angles.reshape(n, k, 1) + by_mount @ mount[:, None],
                                                 against.jacobian.reshape(n, k, PARAMETERS), by_mount, np.zeros((n, k, 1))], axis=2))
    return both[..., 0], both[..., 1:]
