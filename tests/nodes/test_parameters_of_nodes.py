"""`param.py` (and so `ros2 param`) at a node that runs."""

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
    assert param("describe", "/controller", name).stdout == described
    unknown = param("set", "/controller", "no_such_gain", "1.0")
    assert unknown.returncode != 0 and "no_such_gain" in unknown.stdout + unknown.stderr
    fixed = param("describe", "/controller", "vehicle").stdout
    assert "string" in fixed and "read-only" in fixed
    assert param("set", "/controller", "vehicle", "rpg").returncode == 1
