"""Sensor data: IMU samples, images, camera models, transforms. Stamps are whole nanoseconds."""

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
        frame: frame of both vectors; nodes rotate samples of frames other than `imu_link` into B.
    """

    stamp: int
    w_B: tuple[float, float, float]
    f_B: tuple[float, float, float]
    frame: str = "imu_link"


class CameraImage:
    """One image; it may be rendered only when its pixels are read.

    Attributes:
        CHANNELS: encoding -> number of channels of 8 bits.
        stamp: stamp of the camera board: middle of the exposure plus the camera's stamp offset [ns].
        frame: optical frame.
        width, height: [px].
        encoding: one of `CHANNELS`.
        ready: reports whether `pixels` returns at once; None: always. The scheduler waits until an image is rendered.
    """

    CHANNELS = {"mono8": 1, "rgb8": 3, "bgr8": 3}
    __slots__ = ("stamp", "frame", "width", "height", "encoding", "_pixels", "ready")

    def __init__(self, stamp: int, frame: str, width: int, height: int, encoding: str, pixels: np.ndarray | Callable[..., np.ndarray | None],
                 ready: Callable[..., bool] | None = None) -> None:
        """
        Args:
            stamp, frame, width, height, encoding: as above.
            pixels: the image, uint8 (height, width) or (height, width, 3); or a function of a region (or None) that renders it.
            ready: `ready(timeout)` waits at most `timeout` [s] and reports whether the image has been rendered.
        """
        self.stamp, self.frame, self.width, self.height, self.encoding = stamp, frame, width, height, encoding
        self._pixels, self.ready = pixels, ready

    def pixels(self, region: Region | None = None) -> np.ndarray | None:
        """The image, uint8, (height, width) or (height, width, 3) by the encoding; None: the renderer has ended.

        Args:
            region: rows and columns that the first caller needs; others need not be rendered. None: the whole image.
        """
        if callable(self._pixels):
            return self._pixels(region)
        return self._pixels


class CameraModel(NamedTuple):
    """Intrinsics of a camera, as in `camera_info`: published with every image, with the image's stamp [ns]."""

    stamp: int
    frame: str
    camera: Camera


class Transform(NamedTuple):
    """Pose of a frame in another: `p` position of the child's origin in the parent [m], `q` attitude xyzw."""

    parent: str
    child: str
    p: tuple[float, float, float]
    q: tuple[float, float, float, float]


class StampedTransform(NamedTuple):
    """Pose of a frame in another at a stamp [ns]; other fields as in `Transform`."""

    stamp: int
    parent: str
    child: str
    p: tuple[float, float, float]
    q: tuple[float, float, float, float]


class CompressedPixels(NamedTuple):
    """An image in a compressed form.

    Attributes:
        stamp: stamp of the source image [ns].
        frame: optical frame.
        format: jpeg or png.
        data: the compressed image.
    """

    stamp: int
    frame: str
    format: str
    data: bytes


class Serialized(NamedTuple):
    """A serialised message of any topic, for components that forward or record messages.

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
