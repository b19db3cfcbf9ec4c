"""Node `estimator`: `ros2 run perch_perception estimator`."""

from perch_core.interrupts import quiet_on_interrupt

with quiet_on_interrupt():
    from perch_core.ros.node import NodeSpec
    from perch_perception.estimator_component import StateEstimator
    from perch_perception.estimators import estimator_class

NODE = NodeSpec("estimator", StateEstimator, deadline="odometry", choose=estimator_class)
create, main = NODE.create, NODE.main
