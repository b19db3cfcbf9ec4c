"""Images of ROS become images of the components, whatever their encoding."""

from __future__ import annotations

import array
import struct
import zlib

import cv2
import numpy as np
import pytest
from perch_core.errors import PerchError
from perch_core.ros.messages.sensing import compressed_value, image_value, pack_image, unpack_image
from perch_core.values import CameraImage
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image


def message(encoding, channels, padding=0):
    rows = np.arange(4 * (8 * channels + padding), dtype=np.uint8).reshape(4, -1)
    return Image(height=4, width=8, encoding=encoding, step=rows.shape[1], data=array.array("B", rows.tobytes())), rows[:, : 8 * channels]


@pytest.mark.parametrize("encoding, channels, named", [
    ("mono8", 1, "mono8"), ("8UC1", 1, "mono8"), ("rgb8", 3, "rgb8"), ("bgr8", 3, "bgr8"), ("8UC3", 3, "bgr8")])
@pytest.mark.parametrize("padding", [0, 5])
def test_every_encoding_of_8_bits_is_read_by_rows(encoding, channels, named, padding):
    sent, rows = message(encoding, channels, padding)
    for image in (image_value(sent), unpack_image(serialize_message(sent))):
        assert (image.width, image.height, image.encoding) == (8, 4, named)
        np.testing.assert_array_equal(image.pixels().reshape(4, -1), rows)
        np.testing.assert_array_equal(unpack_image(pack_image(image)).pixels(), image.pixels())


def test_a_packed_image_is_the_message_of_rclpy_and_its_pixels_are_not_copied_when_it_is_read():
    pixels = np.arange(24, dtype=np.uint8).reshape(4, 6)
    data = pack_image(CameraImage(5_000_000_123, "camera_down_optical_frame", 6, 4, "mono8", pixels[:, ::-1]))
    sent = deserialize_message(data, Image)
    assert (sent.header.stamp.sec, sent.header.stamp.nanosec, sent.header.frame_id) == (5, 123, "camera_down_optical_frame")
    assert (sent.width, sent.height, sent.step, sent.encoding) == (6, 4, 6, "mono8") and bytes(sent.data) == pixels[:, ::-1].tobytes()
    assert np.shares_memory(unpack_image(data).pixels(), np.frombuffer(data, np.uint8))
    for length in range(0, len(data), 7):
        with pytest.raises(PerchError):
            unpack_image(data[:length])


def test_other_encodings_are_refused_with_those_that_are_read():
    with pytest.raises(PerchError, match="'mono16' is not one of mono8, rgb8, bgr8, 8UC1, 8UC3"):
        image_value(message("mono16", 2)[0])


@pytest.mark.parametrize("kind", [".png", ".jpg"])
@pytest.mark.parametrize("shape", [(4, 8), (40, 30, 3)])
def test_compressed_images_are_read(kind, shape):
    sent = np.full(shape, 77, np.uint8)
    image = compressed_value(CompressedImage(format=kind[1:], data=array.array("B", cv2.imencode(kind, sent)[1].tobytes())))
    assert (image.height, image.width) == shape[:2] and np.abs(image.pixels().astype(int) - sent).max() <= 1


def png(width, height):
    """The few bytes of a PNG that states a size; its pixels are cut off."""
    chunk = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + chunk + struct.pack(">I", zlib.crc32(chunk)) + struct.pack(">I", 100) + b"IDAT"


def jpeg(width, height):
    """A JPEG of 8 x 8 px that states another size, behind a comment that looks like a size."""
    data = cv2.imencode(".jpg", np.zeros((8, 8), np.uint8))[1].tobytes()
    size = data.index(b"\xff\xc0") + 5
    data = data[:size] + struct.pack(">HH", height, width) + data[size + 4 :]
    comment = b"\xff\xc0\x00\x0b\x08\x00\x08\x00\x08"
    return data[:2] + b"\xff\xfe" + struct.pack(">H", 2 + len(comment)) + comment + data[2:]


@pytest.mark.parametrize("data, why", [
    (png(20000, 20000), "width: 20000 is outside"), (png(10, 10001), "height: 10001 is outside"), (jpeg(20000, 8), "width: 20000 is outside"),
    (jpeg(8, 60000), "height: 60000 is outside"), (b"", "no JPEG or PNG"), (png(8, 8)[:20], "no JPEG or PNG"), (b"\xff\xd8\xff\xda\x00\x02", "no JPEG or PNG"),
    (b"II*\x00" + bytes(100), "no JPEG or PNG"), (b"\xff\xd8" + b"\xff" * 100, "no JPEG or PNG"), (png(8, 8), "no image of 8 bits")])
def test_a_compressed_image_beyond_the_limits_is_refused_before_it_is_decoded(monkeypatch, data, why):
    if "no image" not in why:
        monkeypatch.setattr(cv2, "imdecode", None)
    with pytest.raises(PerchError, match=why):
        compressed_value(CompressedImage(format="png", data=array.array("B", data)))
