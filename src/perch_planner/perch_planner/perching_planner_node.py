"""Node `perching_planner`: `ros2 run perch_planner perching_planner`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_planner.perching_planner import PerchingPlanner

NODE = NodeSpec("perching_planner", PerchingPlanner)
create, main = NODE.create, NODE.main
