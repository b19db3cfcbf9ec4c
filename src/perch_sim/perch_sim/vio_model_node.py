"""Node `vio_model`: `ros2 run perch_sim vio_model`. A stand-in for VIO that degrades the truth."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_sim.modelled_vio import ModelledVio

NODE = NodeSpec("vio_model", ModelledVio)
create, main = NODE.create, NODE.main
