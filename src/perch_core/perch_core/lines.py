"""Powerline segments, Pluecker lines, and the line costs and constraints of paper P. [P:eq3-13]

The functions are generic over numbers, arrays (many states at once) and CasADi symbols: vectors are tuples of
components, see `components`. Planner, controller and evaluation use the same functions.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from perch_core.arrays import Array
from perch_core.components import (
    Scalar, Vector, add, components, cross, dot, function, rotate_back, scale, stack, subtract,
)
from perch_core.errors import PerchError

_E3 = np.array([0.0, 0.0, 1.0])
_RADIUS_MIN = 1e-3      # radius that is left of a wire [m]
_LEVEL_MIN = 0.1        # sine of a line's angle from the vertical, below which a tilt about it is not defined
ACTIVATION_RAMP = 0.02  # length over which the end of a segment fades in [m]
_STEEPNESS = float(np.arctanh(0.98))  # tanh reaches 1 % and 99 % at the ends of the ramp


@dataclass(frozen=True)
class Segment:
    """A straight piece of powerline.

    Attributes:
        centre: o_W, middle of the segment in W [m], shape (3,).
        direction: l_W, unit vector in W, shape (3,).
        half_length: [m].
        radius: of the wire [m].
        id: number of the segment in the map.
    """

    centre: Array
    direction: Array
    half_length: float
    radius: float
    id: int = 0

    def __post_init__(self) -> None:
        centre, direction = np.array(self.centre, float), np.array(self.direction, float)
        norm = float(np.linalg.norm(direction))
        values = (*centre, *direction, self.half_length, self.radius)
        if centre.shape != (3,) or direction.shape != (3,) or not np.all(np.isfinite(values)):
            raise PerchError(f"line {self.id}: needs a finite centre and direction in 3-d, got {tuple(map(float, values))}")
        if norm == 0 or self.half_length <= 0 or self.radius <= 0:
            raise PerchError(f"line {self.id}: length {2 * self.half_length:g} m and radius {self.radius:g} m must be > 0")
        object.__setattr__(self, "centre", centre)
        object.__setattr__(self, "direction", direction / norm)

    @classmethod
    def between(cls, start: Array, end: Array, radius: float, id: int = 0) -> Segment:
        """Return the segment between two end points in W [m]."""
        start, end = np.asarray(start, float), np.asarray(end, float)
        return cls((start + end) / 2, end - start, float(np.linalg.norm(end - start)) / 2, radius, id)

    def with_reduced_radius(self, reduction: float) -> Segment:
        """Return the segment with its radius reduced by `reduction` [m]; a small radius always remains."""
        return replace(self, radius=max(self.radius - reduction, min(self.radius, _RADIUS_MIN))) if reduction > 0.0 else self

    @property
    def ends(self) -> tuple[Array, Array]:
        """End points in W [m]."""
        return self.centre - self.half_length * self.direction, self.centre + self.half_length * self.direction

    def closest_point(self, point: Array) -> Array:
        """The point of the segment that is nearest to points in W, shapes (..., 3)."""
        along = (np.asarray(point, float) - self.centre) @ self.direction
        return self.centre + np.clip(along, -self.half_length, self.half_length)[..., None] * self.direction

    def distance(self, point: Array) -> Array:
        """Distance of points in W from the wire's axis [m], shapes (..., 3) -> (...)."""
        distances: Array = np.linalg.norm(np.asarray(point, float) - self.closest_point(point), axis=-1)
        return distances


def segment_distance(a: Segment, b: Segment) -> float:
    """Least distance between the axes of two segments [m]."""
    gap, cosine = b.centre - a.centre, float(a.direction @ b.direction)
    sine2 = 1 - cosine**2
    along_a, along_b = float(gap @ a.direction), float(gap @ b.direction)
    candidates = [end for end in b.ends]
    if sine2 > 1e-12:
        s = (along_a - cosine * along_b) / sine2
        t = (cosine * along_a - along_b) / sine2
        if abs(s) <= a.half_length and abs(t) <= b.half_length:
            return float(np.linalg.norm(a.centre + s * a.direction - b.centre - t * b.direction))
    return float(min([a.distance(end) for end in candidates] + [b.distance(end) for end in a.ends]))


def perch_normal(line: Segment, point: Array, pitch: float, side_W: Array) -> Array:
    """Direction of b3 at a perch on a line, unit, shape (3,).

    At pitch 0 it is the direction perpendicular to the line that is nearest to the vertical; `pitch` tilts it towards the side of
    `side_W`. At 0 a level vehicle is above the line, at pi an inverted vehicle is below it.

    Args:
        line: the line to grip.
        point: a point of the line in W [m], shape (3,).
        pitch: tilt about the line, in [0, pi] [rad].
        side_W: a point in W on the side from which the vehicle approaches [m], shape (3,).

    Raises:
        PerchError: the line is vertical.
    """
    up = _E3 - (_E3 @ line.direction) * line.direction
    if np.linalg.norm(up) < _LEVEL_MIN:
        raise PerchError(f"line {line.id} is vertical: a pitch about it is not defined")
    up = up / np.linalg.norm(up)
    side = np.cross(line.direction, up)
    if (np.asarray(side_W, float) - point) @ side < 0:
        side = -side
    normal: Array = np.cos(pitch) * up + np.sin(pitch) * side
    return normal


def scaled_line(p_WB: Vector, q_WB: Vector, o_W: Vector, l_W: Vector, radii: Vector) -> tuple[Vector, Vector]:
    """Line in the body frame, scaled so that the body's ellipsoid is the unit ball. [defines P:eq3]

    Args:
        p_WB, q_WB: pose of the body [m, xyzw].
        o_W, l_W: a point and the direction of the line in W.
        radii: delta, the ellipsoid's radii with the wire's radius added [m].

    Returns:
        o and l in the scaled frame.
    """
    o_B, l_B = rotate_back(q_WB, subtract(o_W, p_WB)), rotate_back(q_WB, l_W)
    return tuple(o / d for o, d in zip(o_B, radii)), tuple(l / d for l, d in zip(l_B, radii))


def line_clearance(o: Vector, l: Vector) -> Scalar:
    """(d^2 - 1) |l|^2 with the line's distance d from the origin of the scaled space; positive: no contact. [defines P:eq4, P:eq5]

    The paper's expression `(|o|^2 - 1) |l|^2 - (o.l)^2 > 0`, from |o x l|^2 = |o|^2 |l|^2 - (o.l)^2.
    """
    return (dot(o, o) - 1) * dot(l, l) - dot(o, l) * dot(o, l)


def segment_activation(p_WB: Vector, o_W: Vector, half_length: Scalar, reach: Scalar) -> Scalar:
    """0 where the body can touch the segment, 1 far from it: sigm of k(x). [defines P:eq6]

    tanh instead of the paper's arctan: arctan's tails leave percents of k(x) in the middle of the segment, where it
    would weaken the constraint. Here less than 1 % is left at half the ramp.

    Args:
        p_WB: body position in W [m].
        o_W: centre of the segment in W [m].
        half_length: [m].
        reach: greatest radius of the ellipsoid plus that of the wire [m].
    """
    offset = subtract(p_WB, o_W)
    edge = half_length + reach + ACTIVATION_RAMP
    # In the squared distance (no root at the centre); 2 edge x ramp is the ramp's extent there.
    rise = _STEEPNESS / (edge * ACTIVATION_RAMP)
    return 0.5 + 0.5 * function("tanh", rise * (dot(offset, offset) - edge * edge))


def segment_clearance(p_WB: Vector, q_WB: Vector, o_W: Vector, l_W: Vector, half_length: Scalar, radius: Scalar,
                      body_radii: Vector) -> Scalar:
    """h_ca: positive where body and segment do not touch. [defines P:eq7]

    [P:eq5] is at least -|l|^2, where the line passes through the body's centre, and |l| is at most lambda_1. The paper adds
    lambda_1^2 far from the segment; h_ca may then fall to zero where the line coincides with the body's thinnest axis, as above a
    mast. Here 3 lambda_1^2 are added, so that far from the segment h_ca >= 2 |l|^2, as for a line at sqrt(3) radii.

    Args:
        p_WB, q_WB: pose of the body [m, xyzw].
        o_W, l_W, half_length, radius: the segment [m].
        body_radii: radii of the body's ellipsoid [m].

    Returns:
        h_ca [1/m^2]; positive everywhere away from the segment.
    """
    radii = tuple(r + radius for r in body_radii)
    o, l = scaled_line(p_WB, q_WB, o_W, l_W, radii)
    smallest, largest = min(body_radii), max(body_radii)
    largest_eigenvalue = 1 / (smallest + radius)  # lambda_1 of Delta
    far = segment_activation(p_WB, o_W, half_length, largest + radius)
    return line_clearance(o, l) + 3 * largest_eigenvalue**2 * far


def scaled_clearance(states_p: Array, states_q: Array, segment: Segment, body_radii: Vector) -> Array:
    """Distance of the finite segment in the scaled frame, minus 1; positive: no contact.

    Used to check finished trajectories, with the segment's true ends instead of the activation of [P:eq6]. As in the paper, the
    body's ellipsoid enlarged by the wire is approximated by longer radii, up to 3.4 mm too short beside a wire of 3 cm.

    Args:
        states_p, states_q: poses of the body [m, xyzw], shapes (n, 3) and (n, 4).
        segment: the wire.
        body_radii: radii of the body's ellipsoid [m].

    Returns:
        Shape (n,), dimensionless.
    """
    radii = tuple(float(r) + segment.radius for r in body_radii)
    o, l = scaled_line(components(states_p), components(states_q), components(segment.centre),
                       components(segment.direction), radii)
    along = np.clip(-dot(o, l) / dot(l, l), -segment.half_length, segment.half_length)
    lengths: Array = np.linalg.norm(stack(add(o, scale(along, l))), axis=-1)
    return lengths - 1


def line_in_camera(p_WB: Vector, q_WB: Vector, o_W: Vector, l_W: Vector, p_BC: Vector, q_BC: Vector
                   ) -> tuple[Vector, Vector]:
    """A line's point and direction in the camera frame C (z forward). [defines P:eq8]"""
    o_B = subtract(rotate_back(q_WB, subtract(o_W, p_WB)), p_BC)
    return rotate_back(q_BC, o_B), rotate_back(q_BC, rotate_back(q_WB, l_W))


def image_line(o_C: Vector, l_C: Vector, fx: float = 1.0, fy: float = 1.0) -> tuple[Vector, Vector]:
    """Pluecker coordinates n_I = K_L (o_C x l_C) and l_I = K_P l_C of a line in the image. [P:IV-D]"""
    n_C = cross(o_C, l_C)
    return (fy * n_C[0], fx * n_C[1], fx * fy * n_C[2]), (fx * l_C[0], fy * l_C[1], l_C[2])


def reprojection_error(n_I: Vector) -> Scalar:
    """r_e: signed distance of the line from the image centre, in units of the focal length (fx = 1) or pixels. [defines P:eq9]

    It also vanishes where the optical axis is parallel to the line and where the line is behind the camera; never use it alone.
    """
    return n_I[2] / function("sqrt", n_I[0] * n_I[0] + n_I[1] * n_I[1])


def centre_points(n_I: Vector, l_I: Vector) -> tuple[Vector, Vector]:
    """p2D, towards the line's point nearest to the image centre, and d3D, its point nearest to the camera. [defines P:eq10]"""
    p2D = (-n_I[0] * n_I[2], -n_I[1] * n_I[2], n_I[0] * n_I[0] + n_I[1] * n_I[1])  # n x (e_z x n)
    return p2D, cross(l_I, n_I)


def cheirality(n_I: Vector, l_I: Vector) -> Scalar:
    """h_lc: positive where the line passes in front of the camera. [defines P:eq12]"""
    return centre_points(n_I, l_I)[1][2]


def segment_place(n_I: Vector, l_I: Vector, o_I: Vector, half_length: Scalar) -> tuple[Scalar, Scalar]:
    """Position along the segment of the line's point that is nearest to the image centre. [defines P:eq11, P:eq13]

    The paper's point p3D = p2D / d3D_z and constraint -(p3D - e1) . (p3D - e2) > 0 have a pole where the optical axis is
    along the line. With p3D = o_I + s half_length l_I the constraint is s^2 < 1; s d and d = d3D_z have no pole.

    Args:
        n_I, l_I: the line, from `image_line` with fx = fy = 1, |l_I| = 1.
        o_I: middle of the segment in that frame [m].
        half_length: [m].

    Returns:
        s d and d [m]; the point is on the segment where |s d| < |d|.
    """
    p2D, d3D = centre_points(n_I, l_I)
    return (dot(p2D, l_I) - d3D[2] * dot(o_I, l_I)) / half_length, d3D[2]
