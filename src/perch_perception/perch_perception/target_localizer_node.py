"""Node `target_localizer`: `ros2 run perch_perception target_localizer`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_perception.target_localizer import TargetLocalizer

NODE = NodeSpec("target_localizer", TargetLocalizer)
create, main = NODE.create, NODE.main
