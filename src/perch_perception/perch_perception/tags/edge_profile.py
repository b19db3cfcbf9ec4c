"""Where a grey-value profile across the edge of a tag steps from the dark border to the light ring.

The ring and the border are one module wide: 1.8 px at 3 m, less than the blur. The far sides of both leak into the
profile, and the centroid of the gradient is then off by 0.1 px, always inwards. Fitting all three steps removes that.
"""

from __future__ import annotations

import cv2
import numpy as np
from scipy.special import erf

STEP = 0.3             # spacing along a profile [px]
BLUR = 0.78            # 1-sigma of optics (0.6 px), pixel (0.29 px) and bilinear sampling (0.41 px) together [px]


def sample_profiles(image: np.ndarray, points: np.ndarray, normals: np.ndarray, reach: float,
                    origin: tuple[int, int] = (0, 0)) -> tuple[np.ndarray, np.ndarray]:
    """Grey values across edges.

    Args:
        image: mono8.
        points: places on the edges [px], shape (..., 2).
        normals: unit normals of the edges there, pointing from dark to light, shape (..., 2).
        reach: half length of the profiles [px].
        origin: pixel (column, row) of the points that is the first of `image`, a part of the camera's.

    Returns:
        Offsets s along the normal (S,) [px] and grey values (..., S).
    """
    s = np.linspace(-reach, reach, max(9, int(2 * reach / STEP) | 1))
    x, y = ((points[..., None, k] + s * normals[..., None, k]).astype(np.float32).reshape(-1, s.size) - np.float32(origin[k])
            for k in (0, 1))
    values = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return s, values.reshape(points.shape[:-1] + (s.size,)).astype(float)


def gradient_centroid(s: np.ndarray, profiles: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Centroid of the rising part: robust far from the edge, biased by neighbouring edges.

    Args:
        s: offsets (S,) [px].
        profiles: grey values (..., S).

    Returns:
        Offset of the step [px] and its height [grey values], shapes (...).
    """
    rise = np.maximum(np.diff(profiles, axis=-1), 0.0)
    height = rise.sum(axis=-1)
    return rise @ (0.5 * (s[1:] + s[:-1])) / np.maximum(height, 1e-6), height


def fit_step(s: np.ndarray, profiles: np.ndarray, module: np.ndarray, blur: float = BLUR,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least-squares position of the step at s = x between its neighbours at x - module and x + module.

    Model: g(s) = c0 + c1 F(s - x) + c2 F(s - x - m) + c3 F(s - x + m), with F the step blurred by a Gaussian. The
    heights c are free (inside, a module of the code is dark or light; outside is whatever surrounds the pad). The
    model is linearised at x = 0, so that one small matrix per edge serves all its profiles.

    Args:
        s: offsets (S,) [px].
        profiles: grey values, shape (e, k, S): k profiles across each of e edges.
        module: width of one module across each edge [px], shape (e,).
        blur: 1-sigma of the blur [px].

    Returns:
        Offset x [px], height c1 of the step [grey values], and the information on x [(grey values / px)^2],
        shapes (e, k).
    """
    shifts = np.stack([np.zeros_like(module), module, -module], axis=-1)[:, None, :]  # (e, 1, 3)
    z = (s[:, None] - shifts) / blur
    steps = 0.5 * (1.0 + erf(z / np.sqrt(2.0)))                                   # (e, S, 3)
    slopes = -np.exp(-0.5 * z * z) / (blur * np.sqrt(2.0 * np.pi))                # d step / d x
    basis = np.concatenate([np.ones_like(steps[..., :1]), steps], axis=-1)
    inverse = np.linalg.pinv(basis)                                               # (e, 4, S)
    heights = profiles @ np.swapaxes(inverse, 1, 2)                               # (e, k, 4)
    rest = profiles - heights @ np.swapaxes(basis, 1, 2)
    tangent = heights[..., 1:] @ np.swapaxes(slopes, 1, 2)                        # (e, k, S)
    tangent -= (tangent @ np.swapaxes(inverse, 1, 2)) @ np.swapaxes(basis, 1, 2)  # what the heights cannot explain
    information = np.sum(tangent * tangent, axis=-1)
    offset = np.sum(tangent * rest, axis=-1) / np.maximum(information, 1e-9)
    return offset, heights[..., 1], information
