"""Node `viewer`: `ros2 run perch_eval viewer`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_eval.ros.viewer import Viewer

NODE = NodeSpec("viewer", Viewer)
create, main = NODE.create, NODE.main
