"""Node `vio`: `ros2 run perch_perception vio`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_perception.vio_component import VioComponent

NODE = NodeSpec("vio", VioComponent)
create, main = NODE.create, NODE.main
