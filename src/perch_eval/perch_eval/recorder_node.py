"""Node `recorder`: `ros2 run perch_eval recorder`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_eval.ros.recorder import Recorder

NODE = NodeSpec("recorder", Recorder)
create, main = NODE.create, NODE.main
