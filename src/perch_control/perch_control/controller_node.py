"""Node `controller`: `ros2 run perch_control controller`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_control.controller import Controller
    from perch_core.ros.node import NodeSpec

NODE = NodeSpec("controller", Controller, deadline="motor_command")
create, main = NODE.create, NODE.main
