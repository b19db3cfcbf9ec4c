"""Position and blur of the step from a tag's dark border to its light ring in a grey-value profile across the edge.

A ring and a border of one module are 1.8 px wide at 3 m, about as much as the blur. The far sides of both leak into the
profile, and the centroid of the gradient is then off by 0.1 px, always inwards. Fitting all three steps removes this bias, if
the blur is right: it results from the lens, the focus, the motion across this edge and the camera's own sharpening.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.special import erf

STEPS = 33                             # samples of a profile
BLURS = np.geomspace(0.4, 3.2, 7)      # 1 sigma, from sharpened to out of focus or moving [px]
ROUNDING = 0.05                        # variance of a mean profile by the rounding of its grey values
USUAL_SPREAD = 0.4                     # of an edge's log blur about that of the image's other edges, 1 sigma


def sample_profiles(image: np.ndarray, points: np.ndarray, normals: np.ndarray, s: np.ndarray,
                    origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Return the grey values across edges, shape (..., S).

    Args:
        image: mono8.
        points: points on the edges [px], shape (..., 2).
        normals: unit normals of the edges there, pointing from dark to light, shape (..., 2).
        s: offsets along the normals, to be broadcast to shape (..., S) [px].
        origin: column and row of the first pixel of `image` in the camera's image.
    """
    x, y = ((points[..., None, k] + s * normals[..., None, k]).astype(np.float32) - np.float32(origin[k]) for k in (0, 1))
    flat = len(x), -1  # a row for each tag: OpenCV takes up to 32767 rows and columns
    values = cv2.remap(image, x.reshape(flat), y.reshape(flat), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return values.reshape(x.shape).astype(float)


def gradient_centroid(s: np.ndarray, profiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Locate a step by the centroid of its squared rising slope: robust far from the edge, biased by neighbouring edges.

    Args:
        s: offsets, to be broadcast to shape (..., S) [px].
        profiles: grey values, shape (..., S).

    Returns:
        Offset of the step [px] and its height [grey values], shapes (...).
    """
    rise = np.maximum(np.diff(profiles, axis=-1), 0.0)
    steep = rise * rise
    return np.sum(steep * 0.5 * (s[..., 1:] + s[..., :-1]), axis=-1) / np.maximum(steep.sum(axis=-1), 1e-6), rise.sum(axis=-1)


def blur_of(s: np.ndarray, profiles: np.ndarray, module: np.ndarray) -> np.ndarray:
    """Return the blur of each edge [px], shape (e,), with which the three steps fit its mean profile best.

    An edge with little information (its module is narrower than the blur) takes the blur of the image's other edges.

    Args:
        s: offsets, shape (e, S) [px].
        profiles: mean grey values across e edges, shape (e, S).
        module: width of one module across each edge [px], shape (e,).
    """
    basis, slopes = _steps(s, module, np.repeat(BLURS[:, None], len(s), axis=1))
    basis = np.concatenate([basis, slopes[..., :1]], axis=-1)  # (B, e, S, 5): the edge may be a little off
    back = np.swapaxes(basis, -1, -2)
    heights = np.linalg.solve(back @ basis + 1e-6 * np.eye(basis.shape[-1]), back @ profiles[..., None])
    rest = np.sum((profiles - (basis @ heights)[..., 0]) ** 2, axis=-1)            # (B, e)
    noise = rest.min(axis=0) / (s.shape[-1] - 6) + ROUNDING
    log = np.log(BLURS)
    alone = log[np.argmin(rest, axis=0)]
    cost = rest / noise + ((log[:, None] - np.median(alone)) / USUAL_SPREAD) ** 2
    best = np.clip(np.argmin(cost, axis=0), 1, len(BLURS) - 2)
    before, at, after = (cost[best + k, np.arange(len(s))] for k in (-1, 0, 1))
    shift = np.clip(0.5 * (before - after) / np.maximum(before - 2.0 * at + after, 1e-9), -1.0, 1.0)
    return np.exp(log[best] + shift * (log[1] - log[0]))


def fit_step(s: np.ndarray, profiles: np.ndarray, module: np.ndarray, blur: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fit the position of the step at s = x between its neighbours at x - module and x + module.

    Model: g(s) = c0 + c1 F(s - x) + c2 F(s - x - m) + c3 F(s - x + m), with F the step blurred by a Gaussian. The
    heights c are free (inside, a module of the code is dark or light; outside, the surroundings are arbitrary). The
    model is linearised at x = 0, so that one small matrix per edge serves all its profiles.

    Args:
        s: offsets, shape (e, S) [px].
        profiles: grey values, shape (e, k, S): k profiles across each of e edges.
        module: width of one module across each edge [px], shape (e,).
        blur: 1-sigma of the blur of each edge [px], shape (e,).

    Returns:
        Offset x [px], height c1 of the step [grey values], the information on x [(grey values / px)^2] and the
        misfit of the profile [grey values], shapes (e, k).
    """
    basis, slopes = _steps(s, module, blur)
    inverse = np.linalg.pinv(basis)                                               # (e, 4, S)
    heights = profiles @ np.swapaxes(inverse, 1, 2)                               # (e, k, 4)
    rest = profiles - heights @ np.swapaxes(basis, 1, 2)
    tangent = heights[..., 1:] @ np.swapaxes(slopes, 1, 2)                        # (e, k, S)
    tangent -= (tangent @ np.swapaxes(inverse, 1, 2)) @ np.swapaxes(basis, 1, 2)  # what the heights cannot explain
    information = np.sum(tangent * tangent, axis=-1)
    offset = np.sum(tangent * rest, axis=-1) / np.maximum(information, 1e-9)
    misfit = np.sqrt(np.maximum(np.sum(rest * rest, axis=-1) - offset**2 * information, 0.0) / (s.shape[-1] - 5))
    return offset, heights[..., 1], information, misfit


def _steps(s: np.ndarray, module: np.ndarray, blur: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """1 and the three steps (..., e, S, 4), and the steps' derivatives by x (..., e, S, 3), for blurs (..., e)."""
    shifts = np.stack([np.zeros_like(module), module, -module], axis=-1)[:, None, :]  # (e, 1, 3)
    blur = blur[..., None, None]
    z = (s[..., None] - shifts) / blur
    steps = 0.5 * (1.0 + erf(z / np.sqrt(2.0)))
    slopes = -np.exp(-0.5 * z * z) / (blur * np.sqrt(2.0 * np.pi))
    return np.concatenate([np.ones_like(steps[..., :1]), steps], axis=-1), slopes
