"""What the graph says of a node: its topics and services stand at its name, as `ros2 node info` shows them."""

import time

import rclpy
from nodes.node_process import PATIENCE
from rclpy.context import Context
from rclpy.node import Node

WRITES = {"estimator": "/odometry", "controller": "/motor_command", "vio": "/vio/odometry", "target_localizer": "/target/pose"}
READS = {"estimator": "/imu/data_raw", "controller": "/odometry", "vio": "/camera_down/image_raw", "target_localizer": "/camera_front/image_raw"}


def test_topics_and_services_stand_at_the_name_of_the_node(graph):
    context = Context()
    rclpy.init(context=context)
    looker = Node("looker", context=context, enable_rosout=False, start_parameter_services=False)
    try:
        end = time.monotonic() + PATIENCE
        left = {(name, kind) for name in WRITES for kind in ("writes", "reads", "parameters")}
        while left and time.monotonic() < end:
            known = {name for name, _ in looker.get_node_names_and_namespaces()}
            for name in WRITES.keys() & known:
                written = dict(looker.get_publisher_names_and_types_by_node(name, "/"))
                read = dict(looker.get_subscriber_names_and_types_by_node(name, "/"))
                services = dict(looker.get_service_names_and_types_by_node(name, "/"))
                for kind, there in (("writes", WRITES[name] in written), ("reads", READS[name] in read),
                                    ("parameters", f"/{name}/get_parameters" in services)):
                    if there:
                        left.discard((name, kind))
            time.sleep(0.1)
        assert not left
        assert not [name for name, _ in looker.get_node_names_and_namespaces() if name.endswith("_starting")]
        assert {info.node_name for info in looker.get_publishers_info_by_topic("/odometry")} == {"estimator"}
    finally:
        looker.destroy_node()
        rclpy.shutdown(context=context)
