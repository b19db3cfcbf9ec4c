"""One moment of a recorded flight as a picture: room, pad, paths, vehicle, camera image, height and tilt."""

from __future__ import annotations

import cv2
import numpy as np
from matplotlib.figure import Figure

from perch_core import so3
from perch_eval.flight_view import ESTIMATE, LIMIT, TRUTH, WANTED, FlightView
from perch_eval.metrics import tilt_degrees

ARM = 1.6   # rotors are drawn so much larger than they are, to be seen


class Scene:
    """Draws the frames of one animation on one figure."""

    def __init__(self, view: FlightView, start: float, end: float) -> None:
        """
        Args:
            view: what is shown.
            start, end: time span of the animation [s].
        """
        self._view, self._start, self._end = view, start, end
        self._rotors = np.column_stack([ARM * np.array(view.vehicle.rotor_xy), np.zeros(4)])
        self._inside = (view.truth.t >= start) & (view.truth.t <= end)
        self.figure = Figure(figsize=(10.0, 5.4), layout="constrained")
        grid = self.figure.add_gridspec(3, 3)
        self._space = self.figure.add_subplot(grid[:, :2], projection="3d")
        self._image = self.figure.add_subplot(grid[0, 2])
        self._height, self._tilt = self.figure.add_subplot(grid[1, 2]), self.figure.add_subplot(grid[2, 2])
        self._draw_space()
        self._draw_plots()

    def _draw_space(self) -> None:
        view, axes = self._view, self._space
        p = view.truth.p[self._inside]
        low, high = p.min(axis=0), p.max(axis=0)
        if (ring := view.pad_corners) is not None:
            axes.plot(*np.vstack([ring, ring[:1]]).T, color="k", lw=2.0)
            low, high = np.minimum(low, ring.min(axis=0)), np.maximum(high, ring.max(axis=0))
        for cable in view.cables:
            axes.plot(*cable.T, color=LIMIT, lw=1.5)
        if view.reference is not None:
            keep = (view.reference.t >= self._start) & (view.reference.t <= self._end)
            axes.plot(*view.reference.p[keep].T, color=WANTED, lw=1.0, label="reference")
        (self._path,) = axes.plot([], [], [], color=TRUTH, lw=1.6, label="flown")
        (self._estimated,) = axes.plot([], [], [], color=ESTIMATE, lw=0.9, ls="--", label="estimate")
        self._arms = [axes.plot([], [], [], color="0.2", lw=2.2)[0] for _ in range(2)]
        (self._discs,) = axes.plot([], [], [], "o", color="0.2", ms=6, mfc="none")
        (self._b3,) = axes.plot([], [], [], color=LIMIT, lw=1.6)
        middle, half = (low + high) / 2, max(0.6, float((high - low).max()) / 2 + 0.2)
        for name, centre in zip("xyz", middle):
            getattr(axes, f"set_{name}lim")(centre - half, centre + half)
            getattr(axes, f"set_{name}label")(f"{name} [m]")
        axes.set_box_aspect((1, 1, 1))
        axes.locator_params(nbins=5)
        axes.tick_params(labelsize=8)
        axes.view_init(elev=14.0, azim=-62.0)
        axes.legend(fontsize=8, loc="upper left")

    def _draw_plots(self) -> None:
        truth = self._view.truth
        t = truth.t[self._inside]
        self._height.plot(t, truth.p[self._inside, 2], color=TRUTH, lw=1.1)
        self._height.set_ylabel("z [m]", fontsize=8)
        self._tilt.plot(t, tilt_degrees(truth.q[self._inside]), color=TRUTH, lw=1.1)
        self._tilt.set_ylabel("tilt [deg]", fontsize=8)
        self._tilt.set_xlabel("time [s]", fontsize=8)
        self._cursors = [axes.axvline(self._start, color=LIMIT, lw=0.9) for axes in (self._height, self._tilt)]
        for axes in (self._height, self._tilt):
            axes.grid(alpha=0.3)
            axes.tick_params(labelsize=7)
        self._image.set_xticks([])
        self._image.set_yticks([])
        self._shown = self._image.imshow(np.zeros((480, 640), np.uint8), cmap="gray", vmin=0, vmax=255)
        self._image.set_title("front camera" if self._view.camera else "no camera images recorded", fontsize=8)

    def draw(self, time: float) -> None:
        """Show the flight at a time [s]."""
        view = self._view
        so_far = self._inside & (view.truth.t <= time)
        self._path.set_data_3d(*view.truth.p[so_far].T)
        if view.estimate is not None:
            keep = (view.estimate.t >= self._start) & (view.estimate.t <= time)
            self._estimated.set_data_3d(*view.estimate.p[keep].T)
        now = view.truth.at(np.array([time]))
        p, R = now.p[0], so3.quat_to_matrix(now.q[0])
        rotors = p + self._rotors @ R.T
        for arm, (a, b) in zip(self._arms, ((0, 2), (1, 3))):
            arm.set_data_3d(*rotors[[a, b]].T)
        self._discs.set_data_3d(*rotors.T)
        self._b3.set_data_3d(*np.array([p, p + 0.35 * R[:, 2]]).T)
        for cursor in self._cursors:
            cursor.set_xdata([time, time])
        self._show_image(time)
        speed = float(np.linalg.norm(now.v[0]))
        self._space.set_title(f"t = {time:.2f} s   {speed:.1f} m/s   tilt {tilt_degrees(now.q)[0]:.0f} deg", fontsize=10)

    def _show_image(self, time: float) -> None:
        seen = [image for t, image in self._view.camera if t <= time]
        if seen:
            pixels = seen[-1].pixels()
            if pixels is not None:
                self._shown.set_data(pixels if pixels.ndim == 2 else cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY))
