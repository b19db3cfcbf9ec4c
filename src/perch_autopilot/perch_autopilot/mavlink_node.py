"""Node `mavlink`: `ros2 run perch_autopilot mavlink`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_autopilot.mavlink import Mavlink
    from perch_core.ros.node import NodeSpec

NODE = NodeSpec("mavlink", Mavlink)
create, main = NODE.create, NODE.main
