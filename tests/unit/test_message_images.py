"""Images of ROS become images of the components, whatever their encoding."""

from __future__ import annotations

import array

import numpy as np
import pytest
from perch_core.errors import PerchError
from perch_core.ros.messages.sensing import image_message, image_value
from sensor_msgs.msg import Image


def message(encoding, channels, padding=0):
    rows = np.arange(4 * (8 * channels + padding), dtype=np.uint8).reshape(4, -1)
    return Image(height=4, width=8, encoding=encoding, step=rows.shape[1], data=array.array("B", rows.tobytes())), rows[:, : 8 * channels]


@pytest.mark.parametrize("encoding, channels, named", [
    ("mono8", 1, "mono8"), ("8UC1", 1, "mono8"), ("rgb8", 3, "rgb8"), ("bgr8", 3, "bgr8"), ("8UC3", 3, "bgr8")])
@pytest.mark.parametrize("padding", [0, 5])
def test_every_encoding_of_8_bits_is_read_by_rows(encoding, channels, named, padding):
    sent, rows = message(encoding, channels, padding)
    image = image_value(sent)
    assert (image.width, image.height, image.encoding) == (8, 4, named)
    np.testing.assert_array_equal(image.pixels().reshape(4, -1), rows)
    np.testing.assert_array_equal(image_value(image_message(image)).pixels(), image.pixels())


def test_other_encodings_are_refused_with_those_that_are_read():
    with pytest.raises(PerchError, match="'mono16' is not one of mono8, rgb8, bgr8, 8UC1, 8UC3"):
        image_value(message("mono16", 2)[0])
