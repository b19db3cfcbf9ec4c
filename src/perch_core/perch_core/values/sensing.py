"""What sensors give: IMU samples, images, camera models, transforms. Stamps are whole nanoseconds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from perch_core.camera import Camera, Region


class ImuSample(NamedTuple):
    """One IMU sample.

    Attributes:
        stamp: [ns].
        w_B: angular velocity [rad/s], 3 floats.
        f_B: specific force [m/s^2], 3 floats.
        frame: whose axes both are in; the nodes turn what is not in those of `imu_link` = B.
    """

    stamp: int
    w_B: tuple[float, float, float]
    f_B: tuple[float, float, float]
    frame: str = "imu_link"


class CameraImage:
    """One image, drawn or decoded when it is looked at.

    Attributes:
        stamp: the board's: middle of the exposure plus the camera's stamp offset [ns].
        frame: optical frame.
        width, height: [px].
        encoding: mono8, rgb8 or bgr8.
        ready: whether `pixels` returns at once; None: always. An image that is being drawn elsewhere is waited for by whoever schedules.
    """

    __slots__ = ("stamp", "frame", "width", "height", "encoding", "_pixels", "ready")

    def __init__(self, stamp: int, frame: str, width: int, height: int, encoding: str, pixels: np.ndarray | Callable[..., np.ndarray | None],
                 ready: Callable[..., bool] | None = None) -> None:
        """
        Args:
            stamp, frame, width, height, encoding: as above.
            pixels: the image, uint8 (height, width) or (height, width, 3); or a function of a region (or None) that draws it.
            ready: whether it has been drawn, `ready(timeout)` with a wait of at most `timeout` [s].
        """
        self.stamp, self.frame, self.width, self.height, self.encoding = stamp, frame, width, height, encoding
        self._pixels, self.ready = pixels, ready

    def pixels(self, region: Region | None = None) -> np.ndarray | None:
        """The image, uint8, (height, width) or (height, width, 3) by the encoding; None: whoever draws has ended.

        Args:
            region: rows and columns that matter to who asks first; the rest need not be drawn. None: all of it.
        """
        if callable(self._pixels):
            return self._pixels(region)
        return self._pixels


class CameraModel(NamedTuple):
    """Intrinsics of a camera, as `camera_info` gives them: with every frame, of the frame's stamp [ns]."""

    stamp: int
    frame: str
    camera: Camera


class Transform(NamedTuple):
    """Where a frame is in another: `p` position of the child's origin in the parent [m], `q` attitude xyzw."""

    parent: str
    child: str
    p: tuple[float, float, float]
    q: tuple[float, float, float, float]


class StampedTransform(NamedTuple):
    """Where a frame is in another at a stamp [ns]; the rest as in `Transform`."""

    stamp: int
    parent: str
    child: str
    p: tuple[float, float, float]
    q: tuple[float, float, float, float]


class CompressedPixels(NamedTuple):
    """An image in a compressed form.

    Attributes:
        stamp: of the image that it was made from [ns].
        frame: optical frame.
        format: jpeg or png.
        data: the compressed image.
    """

    stamp: int
    frame: str
    format: str
    data: bytes


class Serialized(NamedTuple):
    """A message of any topic as it is on the wire, for components that pass messages on or keep them.

    Attributes:
        topic: fully resolved name.
        stamp: of the message's header [ns].
        data: serialised message.
        message: its ROS class; opaque to components.
    """

    topic: str
    stamp: int
    data: bytes
    message: Any
