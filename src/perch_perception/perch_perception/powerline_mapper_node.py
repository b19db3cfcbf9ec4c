"""Node `powerline_mapper`: `ros2 run perch_perception powerline_mapper`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_perception.powerline_mapper import PowerlineMapper

NODE = NodeSpec("powerline_mapper", PowerlineMapper)
create, main = NODE.create, NODE.main
