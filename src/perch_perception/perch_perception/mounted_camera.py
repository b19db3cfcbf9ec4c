"""Camera of a component as it becomes known: intrinsics from `camera_info`, extrinsics from a file or TF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import astuple, replace

import numpy as np

from perch_core.camera import Camera
from perch_core.camera_mount import CameraMount
from perch_core.values import CameraModel, Transform
from perch_core.static_transforms import BASE, StaticTransforms
from perch_core.urdf import optical_frame

CONFIRMATIONS = 5  # camera_info in a row with other intrinsics or another frame, after which the change is accepted
TOLERANCE = 1e-6   # up to which intrinsics (relative), positions [m] and attitudes [rad] are the same
REMINDER = 60.0    # between warnings of a frame's name [s]


class MountedCamera:
    """Intrinsics and extrinsics of a camera; rate, exposure and stamp offset are those of `nominal`.

    Args:
        nominal: the camera as the vehicle file or sensor file describes it.
        calibrated: `nominal` is of a sensor file, whose user chooses the frames' names.
        extrinsics: `file`: those of `nominal`; `tf`: the pose of the camera's optical frame in `/tf_static`.
        warn: called with a warning and the least time between two of its kind [s].

    Attributes:
        mount: the camera; None while it is not known, also where its frame has no transform. With `file` and intrinsics equal to the
            nominal ones it is `nominal` itself.
    """

    def __init__(self, nominal: CameraMount, calibrated: bool, extrinsics: str, warn: Callable[[str, float], None]) -> None:
        self.nominal = nominal
        self.mount: CameraMount | None = None
        self._last: CameraMount | None = None  # the mount known last
        self._by_transforms, self._warn = extrinsics == "tf", warn
        self._expects_frame = extrinsics == "file" and not calibrated
        self._transforms = StaticTransforms()
        self._camera: Camera | None = None
        self._frame, self._topic = "", f"camera_{nominal.name}/camera_info"
        self._other: CameraModel | None = None
        self._other_count = 0

    @property
    def known(self) -> CameraMount:
        """`mount`, which must be known: no image is used before."""
        assert self.mount is not None
        return self.mount

    @property
    def missing(self) -> str:
        """Description of what is not known yet; empty once the camera is known."""
        if self.mount is not None:
            return ""
        return f"no {self._topic} yet" if self._camera is None else f"no transform of {self._frame!r} in {BASE} on /tf_static yet"

    def check_image_frame(self, topic: str, frame: str) -> None:
        """Warn if an image's frame is not that of `camera_info`; no name counts as the right one."""
        if frame != self._frame and frame and self._frame:
            self._warn(f"{topic}: frame {frame!r} is not {self._frame!r}, that of {self._topic}: images are used, but may be of another camera", REMINDER)

    def take_model(self, model: CameraModel) -> bool:
        """Take the camera's intrinsics; return whether `mount` is known and has changed."""
        camera, expected = model.camera, optical_frame(self.nominal.name)
        if self._expects_frame and model.frame not in (expected, ""):
            self._warn(f"{self._topic}: frame {model.frame!r} is not {expected!r}, whose pose in the vehicle file is used", REMINDER)
        renamed = self._by_transforms and model.frame != self._frame
        if _is_same(camera, self._camera) and not renamed:
            self._frame, self._other_count = model.frame, 0
            return False
        if self._camera is not None and not self._is_confirmed(model):
            return False
        self._camera = self.nominal.camera if _is_same(camera, self.nominal.camera) else camera
        self._frame, self._other_count = model.frame, 0
        return self._place()

    def take_transform(self, transform: Transform) -> bool:
        """Take a static transform; return whether `mount` is known and has changed."""
        problem = self._transforms.add(transform)
        if problem:
            self._warn(f"/tf_static: {problem}", 1.0)
        return self._by_transforms and self._camera is not None and self._place()

    def _is_confirmed(self, model: CameraModel) -> bool:
        """Whether another camera or frame was received often enough in a row; a single message of another camera is ignored."""
        other, self._other = self._other, model
        follows = other is not None and other.frame == model.frame and _is_same(model.camera, other.camera)
        self._other_count = self._other_count + 1 if follows else 1
        if self._other_count < CONFIRMATIONS:
            self._warn(f"{self._topic}: intrinsics or frame changed: not used until {CONFIRMATIONS} consecutive messages agree", 1.0)
            return False
        self._warn(f"{self._topic}: the camera has changed", 0.0)
        return True

    def _place(self) -> bool:
        before, mount, last = self.mount, self._mount(), self._last
        if mount is not None and (last is None or not (
                _is_same(mount.camera, last.camera) and np.allclose(mount.p_BC, last.p_BC, 0.0, TOLERANCE)
                and np.allclose(mount.R_BC, last.R_BC, 0.0, TOLERANCE))):
            self._last = mount
        self.mount = None if mount is None else self._last
        return self.mount is not None and self.mount is not before

    def _mount(self) -> CameraMount | None:
        assert self._camera is not None  # nothing is placed before its intrinsics have come
        if not self._by_transforms:
            return self.nominal if self._camera is self.nominal.camera else replace(self.nominal, camera=self._camera)
        place = self._transforms.pose(self._frame)
        return None if place is None else replace(self.nominal, camera=self._camera, p_BC=place[0], R_BC=place[1])


def _is_same(a: Camera, b: Camera | None) -> bool:
    """Whether the intrinsics of two cameras agree."""
    if a == b:  # at nearly every frame; the comparison within the tolerance takes 40 times as long
        return True
    if type(a) is not type(b):
        return False
    x, y = np.hstack(astuple(a)), np.hstack(astuple(b))
    return len(x) == len(y) and np.allclose(x, y, TOLERANCE, TOLERANCE)
