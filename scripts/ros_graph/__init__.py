"""Replacement of `ros2 topic`, `param`, `service` and `action` for machines without the `ros2` command.

Only `commands` may be imported outside of perch's environment; everything else needs rclpy.
"""
