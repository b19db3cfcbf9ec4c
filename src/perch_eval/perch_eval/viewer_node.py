"""Node `viewer`: `ros2 run perch_eval viewer`."""

from perch_core.ros.node import node
from perch_eval.ros.codec import MessageCodec
from perch_eval.viewer import Viewer


class MessageViewer(Viewer):
    """With the messages of ROS."""

    codec = MessageCodec()


NODE = node("viewer", MessageViewer)
create, main = NODE.create, NODE.main
