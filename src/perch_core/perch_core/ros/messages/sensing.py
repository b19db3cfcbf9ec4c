"""Conversions of IMU samples, images, camera models and transforms."""

from __future__ import annotations

import array
from io import BytesIO
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import TransformStamped
from perch_core.camera import camera_of, camera_parameters
from perch_core.errors import PerchError
from perch_core.ros.cdr import Layout
from perch_core.ros.messages.basic import flat, floats, header, quaternion_floats, require_measured, stamp_value, to_quaternion, to_vector
from perch_core.values import NANOSECONDS, CameraImage, CameraModel, CompressedPixels, ImuSample, StampedTransform, Transform
from perch_core.values.limits import LIMITS
from PIL import Image as pillow
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu

pillow.MAX_IMAGE_PIXELS = None  # the limits are those of `CameraImage`
_GENERIC = {"8UC1": "mono8", "8UC3": "bgr8"}  # what the bytes mean in ROS' generic encodings
_IMAGE = Layout(Image)


def imu_value(msg: Imu) -> ImuSample:
    """Convert a recorded `sensor_msgs/Imu` to a sample; PerchError if a measurement is missing."""
    require_measured(msg.angular_velocity_covariance[0], msg.linear_acceleration_covariance[0])
    return ImuSample(stamp_value(msg.header.stamp), floats(msg.angular_velocity), floats(msg.linear_acceleration), msg.header.frame_id)


def image_value(msg: Image) -> CameraImage:
    """Convert `sensor_msgs/Image` to an image, as `unpack_image` does."""
    return _image(stamp_value(msg.header.stamp), msg.header.frame_id, msg.height, msg.width, msg.encoding, msg.step, msg.data)


def unpack_image(data: bytes) -> CameraImage:
    """Return the image of a serialised `sensor_msgs/Image`; the pixels are a view of the data.

    Raises:
        PerchError: an encoding other than mono8, 8UC1, rgb8, bgr8, 8UC3, or truncated data.
    """
    sec, nanosec, frame, height, width, encoding, _, step, pixels = _IMAGE.unpack(data)
    return _image(sec * NANOSECONDS + nanosec, frame, height, width, encoding, step, pixels)


def _image(stamp: int, frame: str, height: int, width: int, encoding: str, step: int, data: Any) -> CameraImage:
    meaning = _GENERIC.get(encoding, encoding)
    if meaning not in CameraImage.CHANNELS:
        raise PerchError(f"image: encoding {encoding!r} is not one of {', '.join((*CameraImage.CHANNELS, *_GENERIC))}")
    channels, values = CameraImage.CHANNELS[meaning], np.frombuffer(data, np.uint8)
    if not height or not width or step < width * channels or values.size < step * height:
        raise PerchError(f"image: {values.size} bytes in rows of {step} do not fit {width} x {height} px of {encoding}")
    rows = values[: step * height].reshape(height, step)[:, : width * channels]
    return CameraImage(stamp, frame, width, height, meaning, rows if channels == 1 else rows.reshape(height, width, channels))


def compressed_value(msg: CompressedImage) -> CameraImage:
    """Convert `sensor_msgs/CompressedImage` (JPEG, PNG) to an image.

    Raises:
        PerchError: it cannot be decoded, or its header states a size beyond the limits.
    """
    size = _stated_size(bytes(msg.data))
    if size is None:
        raise PerchError(f"compressed image: {len(msg.data)} bytes of format {msg.format!r} are no JPEG or PNG")
    for name, n in zip(("width", "height"), size):
        if reason := LIMITS[CameraImage][name].problem(n):
            raise PerchError(f"compressed image: {name}: {reason}")
    try:
        pixels = cv2.imdecode(np.frombuffer(msg.data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:  # more pixels than OpenCV decodes
        pixels = None
    if pixels is None or pixels.dtype != np.uint8 or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise PerchError(f"compressed image: {len(msg.data)} bytes of format {msg.format!r} are no image of 8 bits per channel")
    encoding = "mono8" if pixels.ndim == 2 else "bgr8"
    return CameraImage(stamp_value(msg.header.stamp), msg.header.frame_id, pixels.shape[1], pixels.shape[0], encoding, pixels)


def _stated_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height [px] by the header of a JPEG or PNG, without decoding it; None if it has none.

    A few kilobytes can state more pixels than fit into memory, and OpenCV gives the size only after it has decoded them.
    """
    try:
        with pillow.open(BytesIO(data), formats=("JPEG", "PNG")) as image:
            return image.size
    except (OSError, ValueError):
        return None


def compressed_message(image: CompressedPixels) -> CompressedImage:
    """Convert a compressed image to `sensor_msgs/CompressedImage`."""
    msg = CompressedImage(header=header(image.stamp, image.frame), format=image.format)
    msg.data = array.array("B", image.data)
    return msg


def pack_image(image: CameraImage) -> bytes:
    """Return the serialised `sensor_msgs/Image` of an image."""
    pixels = np.ascontiguousarray(image.pixels(), np.uint8)
    return _IMAGE.pack(*divmod(image.stamp, NANOSECONDS), image.frame, image.height, image.width, image.encoding, 0,
                       image.width * CameraImage.CHANNELS[image.encoding], pixels.ravel().data)


def camera_info_value(msg: CameraInfo) -> CameraModel:
    """Convert `sensor_msgs/CameraInfo` (plumb_bob, rational_polynomial, equidistant) to the camera's model.

    Raises:
        PerchError: another distortion model, or invalid intrinsics.
    """
    camera = camera_of(msg.distortion_model, msg.width, msg.height, np.reshape(msg.k, (3, 3)), np.array(msg.d, dtype=float))
    return CameraModel(stamp_value(msg.header.stamp), msg.header.frame_id, camera)


def camera_info_message(model: CameraModel) -> CameraInfo:
    """Convert a camera's model to `sensor_msgs/CameraInfo`."""
    camera = model.camera
    name, d = camera_parameters(camera)
    msg = CameraInfo(header=header(model.stamp, model.frame), height=camera.height, width=camera.width, distortion_model=name)
    msg.d = [float(k) for k in d]
    msg.k, msg.r = camera.K.ravel(), np.eye(3).ravel()
    msg.p = flat(np.hstack([camera.K, np.zeros((3, 1))]))
    return msg


def transform_value(msg: TransformStamped) -> Transform:
    """Convert one `geometry_msgs/TransformStamped`."""
    return Transform(msg.header.frame_id, msg.child_frame_id, floats(msg.transform.translation), quaternion_floats(msg.transform.rotation))


def transform_message(value: Transform, stamp: int = 0) -> TransformStamped:
    """Convert a transform at a stamp [ns] to `geometry_msgs/TransformStamped`."""
    msg = TransformStamped(header=header(stamp, value.parent), child_frame_id=value.child)
    msg.transform.translation, msg.transform.rotation = to_vector(value.p), to_quaternion(value.q)
    return msg


def stamped_transform_value(msg: TransformStamped) -> StampedTransform:
    """Convert one `geometry_msgs/TransformStamped` with its stamp."""
    return StampedTransform(stamp_value(msg.header.stamp), *transform_value(msg))


def stamped_transform_message(value: StampedTransform) -> TransformStamped:
    """Convert a stamped transform to `geometry_msgs/TransformStamped`."""
    return transform_message(Transform(*value[1:]), value.stamp)
