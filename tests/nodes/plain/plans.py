"""Asks both planners from a plain client. Prints what came back as JSON."""

import json
import math

import rclpy
from geometry_msgs.msg import Point
from perch_msgs.msg import Powerline
from perch_msgs.srv import PlanPerch, PlanPowerline


def ask(kind, name: str, request) -> dict:
    client = node.create_client(kind, name)
    assert client.wait_for_service(90.0), name
    future = client.call_async(request)
    rclpy.spin_until_future_complete(node, future, timeout_sec=90.0)
    answer = future.result()
    return {"success": answer.success, "message": answer.message, "parts": len(answer.trajectory.segments) + len(answer.trajectory.points),
            "proofs": [proof.holds for proof in answer.certificates]}


rclpy.init()
node = rclpy.create_node("plain_plans")
wall = PlanPerch.Request(impact_acceleration=math.nan, impact_speed_min=math.nan, impact_speed_max=math.nan, thrust_max=math.nan, thrust_min=math.nan)
wall.start_position.z, wall.target.position.x, wall.target.position.z = 1.2, 1.7, 1.2
wall.target.orientation.y, wall.target.orientation.w = -math.sqrt(0.5), math.sqrt(0.5)
wire = Powerline(id=0, start=Point(x=5.0, y=-2.0, z=4.7), end=Point(x=5.0, y=2.0, z=4.7), radius=0.01)
line = PlanPowerline.Request(lines=[wire], target_line=0, perch_point=Point(x=5.0, y=0.0, z=4.7), perch_pitch=math.radians(20.0), deadline=10.0)
line.start_pose.position.z, line.start_pose.orientation.w = 4.3, 1.0
print(json.dumps({"plan_perch": ask(PlanPerch, "plan_perch", wall), "plan_powerline": ask(PlanPowerline, "plan_powerline", line)}))
