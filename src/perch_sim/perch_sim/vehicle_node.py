"""Node `vehicle`: `ros2 run perch_sim vehicle`. In lockstep it owns the schedule, otherwise the wall clock paces it."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_sim.simulated_vehicle import SimulatedVehicle

NODE = NodeSpec("vehicle", SimulatedVehicle, deadline="imu", lockstep="perch_sim.ros.vehicle_node:VehicleNode",
                real_time="perch_sim.ros.vehicle_node:RealTimeVehicleNode")
create, main = NODE.create, NODE.main
