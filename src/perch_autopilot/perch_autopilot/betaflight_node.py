"""Node `betaflight`: `ros2 run perch_autopilot betaflight`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_autopilot.betaflight import Betaflight
    from perch_core.ros.node import NodeSpec

NODE = NodeSpec("betaflight", Betaflight)
create, main = NODE.create, NODE.main
