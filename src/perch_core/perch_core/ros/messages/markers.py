"""Conversions of markers to and from `visualization_msgs/MarkerArray`."""

from __future__ import annotations

from perch_core.ros.messages.basic import floats, header, quaternion_floats, stamp_value, to_point, to_pose
from perch_core.values import Marker, Markers, Shape
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker as MarkerMessage
from visualization_msgs.msg import MarkerArray


def markers_message(value: Markers) -> MarkerArray:
    """Convert markers, in `map`, to `visualization_msgs/MarkerArray`."""
    return MarkerArray(markers=[_message(item, value.stamp) for item in value.markers])


def markers_value(msg: MarkerArray) -> Markers:
    """Convert `visualization_msgs/MarkerArray`; markers whose type is not in `Shape` are left out."""
    stamp = stamp_value(msg.markers[0].header.stamp) if msg.markers else 0
    return Markers(stamp, tuple(_value(item) for item in msg.markers if item.type in Shape.__members__.values()))


def _message(item: Marker, stamp: int) -> MarkerMessage:
    msg = MarkerMessage(header=header(stamp, "map"), type=int(item.shape), ns=item.ns, id=item.id, pose=to_pose(item.p, item.q),
                        text=item.text, action=MarkerMessage.DELETE if item.removed else MarkerMessage.ADD)
    msg.color = ColorRGBA(**dict(zip("rgba", item.colour)))
    msg.scale.x, msg.scale.y, msg.scale.z = item.scale
    msg.points = [to_point(p) for p in item.points]
    return msg


def _value(msg: MarkerMessage) -> Marker:
    colour = (msg.color.r, msg.color.g, msg.color.b, msg.color.a)
    return Marker(Shape(msg.type), msg.ns, msg.id, colour, floats(msg.scale), floats(msg.pose.position), quaternion_floats(msg.pose.orientation),
                  tuple(floats(p) for p in msg.points), msg.text, msg.action == MarkerMessage.DELETE)
