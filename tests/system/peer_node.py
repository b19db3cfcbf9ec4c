"""A node to talk to: a topic, a parameter, a service and an action. Started by test_scripts_graph.py."""

from __future__ import annotations

import time

import rclpy
from geometry_msgs.msg import PointStamped
from perch_core.ros.node import StopSignal, spin_until_stopped
from perch_msgs.action import Perch
from rcl_interfaces.msg import SetParametersResult
from rclpy.action import ActionServer, CancelResponse
from rclpy.experimental import EventsExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import String
from std_srvs.srv import SetBool


class Peer(Node):
    """Says what it hears, as subscriber of latched messages, knows one gain, can be armed, and flies forever when asked for `takeoff_height` 2."""

    def __init__(self) -> None:
        super().__init__("peer")
        self.declare_parameter("gain", 2.0)
        self.add_on_set_parameters_callback(self._check)
        self._points = self.create_publisher(PointStamped, "points", qos_profile_sensor_data)
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._heard = self.create_publisher(String, "heard", latched)
        self.create_subscription(String, "say", lambda m: self._heard.publish(String(data=f"heard {m.data}")), latched)
        self.create_service(SetBool, "arm", self._arm)
        self._action = ActionServer(self, Perch, "perch", self._fly, cancel_callback=lambda _: CancelResponse.ACCEPT)
        self._count = 0
        self.create_timer(0.01, self._publish)

    def _publish(self) -> None:
        self._count += 1
        message = PointStamped()
        message.header.frame_id = "map"
        message.point.x = float(self._count)
        self._points.publish(message)

    def _check(self, parameters) -> SetParametersResult:
        fine = all(p.name != "gain" or p.value > 0.0 for p in parameters)
        return SetParametersResult(successful=fine, reason="" if fine else "gain must be > 0")

    def _arm(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        response.success, response.message = request.data, "armed" if request.data else "stays disarmed"
        return response

    async def _fly(self, handle) -> Perch.Result:
        handle.publish_feedback(Perch.Feedback(phase="tracking"))
        if handle.request.takeoff_height == 2.0:
            while not handle.is_cancel_requested:
                await self._pause()
            handle.canceled()
            return Perch.Result(success=False, message="cancelled")
        handle.succeed()
        return Perch.Result(success=True, message="perched")

    async def _pause(self) -> None:
        future = rclpy.Future()
        timer = self.create_timer(0.02, lambda: future.set_result(None) if not future.done() else None)
        await future
        self.destroy_timer(timer)


def main() -> None:
    """Run until SIGTERM."""
    stop = StopSignal()
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node, executor = Peer(), EventsExecutor()
    executor.add_node(node)
    bare = Node("bare", start_parameter_services=False)
    print(f"up {time.time_ns()}", flush=True)
    spin_until_stopped(executor, stop)
    node.destroy_node(), bare.destroy_node()
    rclpy.shutdown()


if __name__ == "__main__":
    main()
