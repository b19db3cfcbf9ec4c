"""Node `mission`: `ros2 run perch_control mission`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_control.mission_component import Mission
    from perch_core.ros.node import NodeSpec

NODE = NodeSpec("mission", Mission)
create, main = NODE.create, NODE.main
