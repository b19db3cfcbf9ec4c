"""Node `powerline_planner`: `ros2 run perch_planner powerline_planner`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_planner.powerline_planner import PowerlinePlannerComponent

NODE = NodeSpec("powerline_planner", PowerlinePlannerComponent)
create, main = NODE.create, NODE.main
