"""Linear bounds that a perch nearly always needs, set before its first program is solved.

Perches resemble each other: the thrust comes near its limit late in the run-up, leaning forward, and nearly vanishes, if
anywhere, just before; the rim comes near a flat surface where the rotation begins; and the vehicle turns fastest just
before the tube, when it is three fifths around. A bound there in the direction that is nearly always met saves a round of
program, check and cuts. As with all cuts, no plan is believed because of them.
"""

from __future__ import annotations

from math import cos, sin

import numpy as np

from perch_core.jit import compiled
from perch_core.vehicle import GRAVITY
from perch_planner.cutting import HEIGHT_ROOM, RIM_ROOM
from perch_planner.linear_bounds import no_bounds

_THRUST_AT = ((-1, 0.7), (-1, 0.8), (-1, 0.9), (0, 0.0))  # segments from the last, places
_THRUST_LEANS = ((-0.21, 0.99), (0.0, 0.985))  # leans of the thrust [rad, from upright, backwards], shares of the limit
_FALL_AT = (0.65, 0.75, 0.85)  # places in the segment before the run-up
_FALL_LEAN = 0.35           # [rad] of the thrust where it nearly vanishes there
_FALL_BELOW = 1.6           # [rad] on steeper ones it leans further
_FALL_SHARE = 1.03          # of the limit
_RIM_LEAN = 0.05            # [rad] where the rotation begins
_TURNED_AT = 0.2            # place in the last segment where the rim is near surfaces that are not steep
_TURNED_FOR = (0.35, 1.1)   # [rad] inclinations of these
_RATE_AT = 0.62             # place in the last segment where steep perches turn fastest
_RATE_FOR = (1.2, 2.3)      # [rad] inclinations of these
_RATE_TURNED = 0.61         # share of the inclination that the thrust leans back there
_KEEP_RATE = 0.97           # of the limit


@compiled
def _plane(p_S, v_S, s3, time):
    """Distance of the surface's plane from the origin at a time, along s3 [m]."""
    out = 0.0
    for d in range(3):
        out += s3[d] * (p_S[d] + time * v_S[d])
    return out


@compiled
def cuts_ahead(durations, given, low, high, side, p_S, v_S, s3, extension, clearance, rate):
    """Bounds on thrust, rim and body rate where perches come near their limits. [M:eq16, M:eq13]

    With the thrust's specific force f = a + g e3 and its lean l from upright towards `side`:

    * thrust from above: `n . f <= b` for two directions n, late in the run-up: it holds for every plan that keeps the
      bound. From below `n . f >= b` before the run-up to surfaces that do not overhang;
    * rim: `dist >= r sin(tilt)` with tilt = inclination - l. Where the rotation begins l is nearly zero; soon after, to
      first order in l, `dist + r cos(inclination) l >= r sin(inclination)`, and l is at least `side . a` over the
      greatest f;
    * body rate: `m . j <= W n . f`, with n the direction of f and m = dn/dl where steep perches turn fastest.

    Those of rim and rate are set only in a last segment that starts at a free place.

    Args:
        durations: of the segments [s], shape (f,), f > 1.
        given: number of knots after the start whose positions are given, contact among them.
        low, high: limits of the specific thrust [m/s^2].
        side: of `cutting.turning_side`, shape (3,).
        p_S, v_S, s3, extension, clearance, rate: as for `plan_checks.check`.

    Returns:
        Fields of `Bounds`.
    """
    last = len(durations) - 1
    upright = np.arccos(min(max(s3[2], -1.0), 1.0))
    most = len(_THRUST_LEANS) * len(_THRUST_AT) + len(_FALL_AT) + 5
    owner, segments, places, orders, direction, lower, upper = no_bounds(most, most)
    t = 0
    for segment, place in _THRUST_AT:
        for lean, share in _THRUST_LEANS:
            owner[t], segments[t], places[t] = t, last + segment, place
            for d in range(3):
                direction[t, d] = sin(lean) * side[d]
            direction[t, 2] += cos(lean)
            upper[t] = share * high - direction[t, 2] * GRAVITY
            t += 1
    if last > 1 and upright < _FALL_BELOW:
        for place in _FALL_AT:
            owner[t], segments[t], places[t] = t, last - 2, place
            for d in range(3):
                direction[t, d] = sin(_FALL_LEAN) * side[d]
            direction[t, 2] += cos(_FALL_LEAN)
            lower[t] = _FALL_SHARE * low - direction[t, 2] * GRAVITY
            t += 1
    r = t
    if last >= given:
        segments[t:] = last
        begin = durations[:last].sum()
        owner[t], orders[t] = r, 0
        for d in range(3):
            direction[t, d] = s3[d]
        tilt = sin(min(upright + _RIM_LEAN, 0.5 * np.pi) if upright < 0.5 * np.pi else upright)
        lower[r] = _plane(p_S, v_S, s3, begin) + clearance + RIM_ROOM * extension * tilt + HEIGHT_ROOM
        t, r = t + 1, r + 1
        if _TURNED_FOR[0] < upright < _TURNED_FOR[1]:
            owner[t], places[t], orders[t] = r, _TURNED_AT, 0
            owner[t + 1], places[t + 1] = r, _TURNED_AT
            for d in range(3):
                direction[t, d], direction[t + 1, d] = s3[d], extension * cos(upright) / high * side[d]
            now = begin + _TURNED_AT * durations[last]
            lower[r] = _plane(p_S, v_S, s3, now) + clearance + extension * sin(upright) + HEIGHT_ROOM
            t, r = t + 2, r + 1
        if _RATE_FOR[0] < upright < _RATE_FOR[1]:
            owner[t], places[t], orders[t] = r, _RATE_AT, 3
            owner[t + 1], places[t + 1] = r, _RATE_AT
            lean, share = _RATE_TURNED * upright, _KEEP_RATE * rate
            for d in range(3):
                direction[t, d], direction[t + 1, d] = cos(lean) * side[d], -share * sin(lean) * side[d]
            direction[t, 2] -= sin(lean)
            direction[t + 1, 2] -= share * cos(lean)
            upper[r] = share * cos(lean) * GRAVITY
            t, r = t + 2, r + 1
    return owner[:t], segments[:t], places[:t], orders[:t], direction[:t], lower[:r], upper[:r]
