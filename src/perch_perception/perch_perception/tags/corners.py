"""Least squares over the corners of a board, with uncertain lens and print.

The lens is known to a few tenths of a per cent, which in pixels is more than the corners' noise: k = (fx, fy, cx, cy) is
considered. With the corners' derivative G by k, whitened and in k's sigmas, the residuals' covariance is I + G G^T, and

    W = (I + G G^T)^-1 = I - G (I + G^T G)^-1 G^T,   A = (J^T W J)^-1 J^T W,   cov = A A^T (noise) + A G G^T A^T (lens).

Tags are printed or glued as a whole, each slightly displaced. Their shifts in the board's plane, of one sigma in both directions,
are columns of G like those of the lens, but not part of by_intrinsics; their effect on the pose is part of its noise.

Residuals that neither pose nor lens explains are noise, for example of print and paper, and increase the corners' sigmas.
Otherwise the lens, whose sigma does not depend on the number of corners, would be adjusted to fit errors that are not its own.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from perch_core import so3
from perch_core.camera import Camera
from perch_core.probability import chi2_quantile

MAX_ITERATIONS = 12
CONSISTENT = 0.999  # share of boards that pass where corners are off by what is expected
EXACT_LENS = np.zeros(4)


@lru_cache(maxsize=256)
def limit(freedom: int) -> float:
    """Return the limit of chi^2 over its degrees of freedom, which a share `CONSISTENT` of valid boards meets."""
    return float(chi2_quantile(CONSISTENT, freedom)) / freedom


class Corners:
    """Least squares over measured corners.

    Args:
        camera: the lens.
        points_S: the corners in S, shape (m, 3).
        noise: 1-sigma of each [px], shape (m,).
        pixels: the measured pixels, shape (m, 2).
        lens_sigma: 1-sigma of fx, fy (relative), cx, cy [px], shape (4,).
        print_sigma: 1-sigma of a tag's place on the board, in each direction of its plane [m].
    """

    def __init__(self, camera: Camera, points_S: np.ndarray, noise: np.ndarray, pixels: np.ndarray, lens_sigma: np.ndarray,
                 print_sigma: float = 0.0) -> None:
        self._camera, self._points, self._noise, self._pixels, self._lens_sigma = camera, points_S, noise, pixels, lens_sigma
        self._print_sigma = print_sigma
        self._by_print = np.zeros((2 * len(points_S), 0))  # by the tags' shifts, in their sigmas
        self._consider(pixels)

    def start(self, p: np.ndarray, R: np.ndarray) -> None:
        """Evaluate the lens's derivatives at a pose; at the measured pixels their noise would correlate with the residuals."""
        pixels, seen = self._camera.project(self._points @ R.T + p)
        self._by_print = self._printed(p, R)
        self._consider(np.where(seen[:, None], pixels, self._pixels))

    def _consider(self, pixels: np.ndarray) -> None:
        by_lens = np.zeros((len(pixels), 2, 4))
        by_lens[:, 0, 0], by_lens[:, 1, 1] = pixels[:, 0] - self._camera.cx, pixels[:, 1] - self._camera.cy
        by_lens[:, 0, 2] = by_lens[:, 1, 3] = 1.0
        self._by_lens = (by_lens / self._noise[:, None, None]).reshape(-1, 4)
        self._G = np.concatenate([self._by_lens * self._lens_sigma, self._by_print], axis=1)
        self._back = np.linalg.solve(np.eye(self._G.shape[1]) + self._G.T @ self._G, self._G.T)

    def _printed(self, p: np.ndarray, R: np.ndarray) -> np.ndarray:
        """Return the derivative of the whitened pixels by each tag's shift in sigmas, (2m, m / 2); (2m, 0) without shifts."""
        m = len(self._points)
        if self._print_sigma == 0.0:
            return np.zeros((2 * m, 0))
        by_shift = self._camera.project_jacobian(self._points @ R.T + p) @ (self._print_sigma * R[:, :2]) / self._noise[:, None, None]
        out = np.zeros((m // 4, 8, m // 4, 2))
        tags = np.arange(m // 4)
        out[tags, :, tags] = np.nan_to_num(by_shift).reshape(m // 4, 8, 2)
        return out.reshape(2 * m, m // 2)

    def linearise(self, p: np.ndarray, R: np.ndarray) -> tuple[float, np.ndarray, np.ndarray] | None:
        """Return chi^2, gradient (6,) and Gauss-Newton matrix (6, 6) of the reprojection residuals; None beyond the lens."""
        jacobian, projected = self._jacobian(p, R)
        residual = ((projected - self._pixels) / self._noise[:, None]).ravel()
        if not np.all(np.isfinite(residual)):
            return None
        weighed = self._weighed(residual)
        return float(residual @ weighed), jacobian.T @ weighed, jacobian.T @ self._weighed(jacobian)

    def errors(self, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return at the minimum the covariance of (dp, dtheta) from noise and print (6, 6), and derivative by the lens (6, 4).

        The derivative is -A dr/dk: pixels that are larger because of a longer lens bring the solution nearer than the truth.
        """
        jacobian, projected = self._jacobian(p, R)
        self._by_print = self._printed(p, R)
        self._consider(projected)
        weighed = self._weighed(jacobian)
        A = np.linalg.solve(jacobian.T @ weighed, weighed.T)
        by_print = A @ self._by_print
        return A @ A.T + by_print @ by_print.T, -A @ self._by_lens

    def unexplained(self, p: np.ndarray, R: np.ndarray) -> float:
        """Return the mean square of the whitened residuals of corners or whole tags that neither pose nor lens explains.

        It is 1 where it may be chance. Pose and lens together move a plane's corners like homographies, which have eight
        parameters. Tags are printed or glued as a whole, so the common residual of a tag's corners counts as one error.
        """
        jacobian, projected = self._jacobian(p, R)
        residual = ((projected - self._pixels) / self._noise[:, None]).ravel()
        explaining = np.concatenate([jacobian, self._by_lens], axis=1)
        if self._by_print.size:  # by what print leaves open, residuals are correlated
            root = np.linalg.cholesky(np.eye(len(residual)) + self._by_print @ self._by_print.T)
            residual, explaining = np.linalg.solve(root, residual), np.linalg.solve(root, explaining)
        explaining = explaining / np.linalg.norm(explaining, axis=0)
        rest = residual - explaining @ np.linalg.lstsq(explaining, residual, rcond=1e-6)[0]
        of_tags = 2.0 * rest.reshape(-1, 4, 2).mean(axis=1).ravel()
        means = [(float(part @ part) / (len(part) - 8), len(part) - 8) for part in (rest, of_tags) if len(part) > 8]
        return max((mean for mean, freedom in means if mean > limit(freedom)), default=1.0)

    def rms(self, p: np.ndarray, R: np.ndarray) -> float:
        """Return the RMS residual per image axis [px], weighted by the corners' sigmas."""
        residual = self._camera.project(self._points @ R.T + p)[0] - self._pixels
        return float(np.sqrt(np.sum((residual / self._noise[:, None]) ** 2) / np.sum(2.0 / self._noise**2)))

    def _weighed(self, whitened: np.ndarray) -> np.ndarray:
        """W times residuals or derivatives, shape (2m, ...)."""
        return whitened - self._G @ (self._back @ whitened)

    def _jacobian(self, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the derivative of the whitened pixels by (dp, dtheta), (2m, 6), and the pixels (m, 2); NaN beyond the lens."""
        turned = self._points @ R.T
        points_C = turned + p
        by_point = self._camera.project_jacobian(points_C) / self._noise[:, None, None]
        by_turn = -by_point @ so3.hat(turned)  # d X_C = dtheta x R X
        return np.concatenate([by_point, by_turn], axis=-1).reshape(-1, 6), self._camera.project(points_C)[0]


def refine(corners: Corners, p: np.ndarray, R: np.ndarray) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Run Levenberg-Marquardt on SE(3); return p, R and chi^2, or None where the start is outside of the lens's image."""
    state = corners.linearise(p, R)
    if state is None:
        return None
    chi2, gradient, information = state
    damping = 1e-6
    for _ in range(MAX_ITERATIONS):
        step = -np.linalg.solve(information + damping * np.diag(np.diag(information)), gradient)
        p_new, R_new = p + step[:3], so3.exp(step[3:]) @ R
        trial = corners.linearise(p_new, R_new)
        if trial is None or trial[0] > chi2 + 1e-9:
            damping = max(10.0 * damping, 1e-4)
            if damping > 1e6:
                break
            continue
        gain = chi2 - trial[0]
        p, R, (chi2, gradient, information) = p_new, R_new, trial
        damping *= 0.1
        if gain < 1e-4 * max(chi2, 1.0) or np.abs(step).max() < 1e-7:
            break
    return p, R, chi2
