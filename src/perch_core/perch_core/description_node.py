"""Node `description`: `ros2 run perch_core description`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.description import Description
    from perch_core.ros.node import NodeSpec

NODE = NodeSpec("description", Description)
create, main = NODE.create, NODE.main
