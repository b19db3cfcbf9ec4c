"""ROS starts where it cannot write its log folder."""

from __future__ import annotations

import os

import pytest
from system import forks

pytest.importorskip("rclpy")

PROGRAM = """
import rclpy
from perch_core.ros.ros_init import init_ros
init_ros(["program", "--ros-args", "-r", "__node:=given"])
node = rclpy.create_node("default")
node.get_logger().info(f"I am {node.get_name()}")
node.destroy_node()
rclpy.shutdown()
"""


@pytest.mark.parametrize("changed, problem", [
    ({"HOME": None}, "HOME is not set"), ({"HOME": ""}, "HOME is not set"), ({"HOME": "/proc"}, "/proc/.ros/log: "),
    ({"ROS_HOME": "/dev/null"}, "/dev/null/log: Not a directory"), ({"ROS_LOG_DIR": "/dev/null"}, "/dev/null: "),
    ({"HOME": "{tmp}"}, ""), ({"HOME": None, "ROS_LOG_DIR": "{tmp}/logs"}, "")])
def test_a_node_starts_whether_or_not_the_log_folder_of_ros_can_be_written(changed, problem, ros_domain, tmp_path):
    """A service of systemd has no HOME, a user of a container no home of its own. `rclpy.init` alone raises RCLError there."""
    environment = {name: value for name, value in os.environ.items() if name not in ("ROS_HOME", "ROS_LOG_DIR", *changed)}
    environment |= {name: value.format(tmp=tmp_path) for name, value in changed.items() if value is not None}
    (tmp_path / "program.py").write_text(PROGRAM)
    ran = forks.run(forks.SCRIPTS, [str(tmp_path / "program.py")], 120.0, environment)
    assert ran.returncode == 0, ran.stderr
    assert "I am given" in ran.stderr + ran.stdout
    assert ("warning: ROS writes no log files: " + problem in ran.stderr) is bool(problem), ran.stderr
    assert bool(list(tmp_path.rglob("*.log"))) is not bool(problem)
