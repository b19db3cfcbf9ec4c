"""Topics of TF, for systems with `tf2_msgs`: part of ROS, or built in this workspace."""

from __future__ import annotations

from typing import TYPE_CHECKING

from perch_core.ros import qos
from perch_core.ros.messages.sensing import stamped_transform_message, stamped_transform_value, transform_message, transform_value
from tf2_msgs.msg import TFMessage

if TYPE_CHECKING:
    from perch_core.ros.topics import Topic


def topics() -> tuple[Topic, ...]:
    """Return the rows of `/tf` and `/tf_static`: one transform per value."""
    from perch_core.ros.topics import Topic

    return (
        Topic("/tf", TFMessage, qos.SENSOR, lambda v: TFMessage(transforms=[stamped_transform_message(v)]),
              lambda msg: [stamped_transform_value(t) for t in msg.transforms]),
        Topic("/tf_static", TFMessage, qos.STATIC, lambda v: TFMessage(transforms=[transform_message(v)]),
              lambda msg: [transform_value(t) for t in msg.transforms]))
