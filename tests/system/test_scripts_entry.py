"""Every script: help with examples, clear refusals, and the environment that it enters."""

from __future__ import annotations

import ast
import os
import subprocess
import sys

import pytest
from system.scripts import ROOT, call_script, run_script

SCRIPTS = sorted(path.name for path in (ROOT / "scripts").glob("*.py"))


@pytest.mark.parametrize("script", SCRIPTS)
def test_help_has_examples(script):
    result = call_script(script, "--help")
    assert result.returncode == 0, result.stderr
    assert "example" in result.stdout and f"scripts/{script}" in result.stdout


@pytest.mark.parametrize("script", [name for name in SCRIPTS if name != "test.py"])  # which hands them to pytest
def test_unknown_options_are_refused(script):
    assert call_script(script, "--no-such-option").returncode == 2


def test_a_script_enters_its_environment():
    """All of them by one call, which is shown once; what they say is shown in this process."""
    result = run_script("param.py", "--help", PERCH_ENTERED="")
    assert result.returncode == 0 and result.stdout == call_script("param.py", "--help").stdout
    assert run_script("limits.py", "--no-such-option", PERCH_ENTERED="").returncode == 2


def test_another_ros_distribution_is_refused_in_one_line():
    result = run_script("run_node.py", "vehicle", ROS_DISTRO="humble")
    assert result.returncode == 2
    assert result.stderr.startswith("perch: ROS 2 humble is sourced") and len(result.stderr.splitlines()) == 1


def test_sourcing_gives_a_shell_in_which_everything_is_found():
    line = ("set -eu; source ./setup.bash; source ./setup.bash; vehicle_path=$(command -v vehicle); "
            "python -c 'import rclpy, perch_msgs.msg, perch_core, perch_eval; print(perch_core.__file__)'; "
            "echo $vehicle_path $ROS_AUTOMATIC_DISCOVERY_RANGE $OMP_NUM_THREADS $ROS_DOMAIN_ID "
            "$FASTRTPS_DEFAULT_PROFILES_FILE; "
            "echo $PATH | tr : '\\n' | grep -c '^'$PWD/.venv/bin'$'")
    environment = {"PATH": "/usr/local/bin:/usr/bin:/bin", "HOME": os.environ.get("HOME", "/")}
    result = subprocess.run(["bash", "-c", line], cwd=ROOT, env=environment, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    module, shell, count = result.stdout.splitlines()
    assert module.startswith(str(ROOT))
    assert shell.split() == [f"{ROOT}/install/perch_sim/lib/perch_sim/vehicle", "SUBNET", "1", "42",
                             f"{ROOT}/config/fastdds.xml"]
    assert count == "1"


def test_edits_of_sources_are_live():
    import perch_core

    assert os.path.realpath(perch_core.__file__) == str(ROOT / "src/perch_core/perch_core/__init__.py")


def test_the_test_command_passes_on_what_pytest_says(tmp_path):
    (tmp_path / "test_one.py").write_text("def test_good(): pass\ndef test_bad(): assert False\n")
    command = ["test.py", str(tmp_path), "-p", "no:cacheprovider", f"--rootdir={tmp_path}", "-c", os.devnull]
    failed = run_script(*command)
    assert failed.returncode == 1 and "1 failed, 1 passed" in failed.stdout.splitlines()[-1]
    passed = run_script(*command, "-k", "good")
    assert passed.returncode == 0 and "1 passed" in passed.stdout.splitlines()[-1]
    assert run_script("test.py", "--no-such-option-of-pytest").returncode == 2


def test_fields_of_messages_are_checked_in_tests():
    from geometry_msgs.msg import Point

    with pytest.raises(AssertionError):
        Point(x=1)


def test_scripts_need_nothing_but_the_standard_library_before_set_up():
    code = ("import sys; sys.path.insert(0, 'scripts'); import perch_setup, ros_graph.commands; "
            "print({m.split('.')[0] for m in sys.modules} - set(sys.stdlib_module_names))")
    base = getattr(sys, "_base_executable", sys.executable)
    result = subprocess.run([base, "-I", "-S", "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert ast.literal_eval(result.stdout) <= {"__main__", "perch_setup", "ros_graph"}
