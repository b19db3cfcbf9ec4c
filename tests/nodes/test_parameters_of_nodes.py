"""`param.py` (and so `ros2 param`) at a node that runs; what every node refuses is shown in `test_ros_parameters.py`."""

from __future__ import annotations

from system.scripts import fork_script


def test_a_parameter_is_described_before_and_after_a_refusal_alike(graph):
    def param(*arguments):
        return fork_script("param.py", *arguments, "--spin-time", "60")

    name = "flight.odometry_timeout"
    described = param("describe", "/controller", name).stdout
    assert "double, to 0.25, [s], > 0" in described
    refused = param("set", "/controller", name, "50.0")
    assert refused.returncode == 1 and name in refused.stdout and "50" in refused.stdout
    again = param("describe", "/controller", name, "vehicle").stdout
    assert again.startswith(described)
    fixed = again.removeprefix(described)
    assert fixed.startswith("vehicle: ") and "string" in fixed and "read-only" in fixed
