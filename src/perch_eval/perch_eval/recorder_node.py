"""Node `recorder`: `ros2 run perch_eval recorder`."""

from perch_core.ros.node import node
from perch_eval.recorder import Recorder
from perch_eval.ros.codec import MessageCodec


class MessageRecorder(Recorder):
    """With the messages of ROS."""

    codec = MessageCodec()


NODE = node("recorder", MessageRecorder)
create, main = NODE.create, NODE.main
