"""Scripts refuse what they cannot work with before they begin, in one line that names the option; exit code 2."""

from __future__ import annotations

import argparse
import importlib
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import bench
import harness
import pytest
import service
from perch_eval.arguments import locked_folder, output_folder
from ros_graph import commands
from ros_graph.commands import GraphError, NoAnswerError

SCRIPTS = Path(__file__).resolve().parents[2] / "scripts"


class Entered(Exception):
    """The arguments were accepted."""


@pytest.fixture
def run(monkeypatch, tmp_path):
    """Runs a script's `main` up to where it enters its environment, in an empty folder with a file `file` in it."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(SCRIPTS))
    Path("file").touch()

    def enter():
        raise Entered

    def run_(name: str, *arguments: str):
        spec = importlib.util.spec_from_file_location(f"script_{name}", SCRIPTS / f"{name}.py")
        script = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(script)
        monkeypatch.setattr(script, "enter", enter, raising=False)
        monkeypatch.setattr(sys, "argv", [name, *arguments])
        if hasattr(script, "main"):
            script.main()
        else:
            script.command_line().parse_args(arguments)
            raise Entered

    return run_


@pytest.mark.parametrize("name, arguments, words", [
    ("start_stack", ("--ready-timeout", "nan"), "--ready-timeout nan is not > 0 s"),
    ("start_stack", ("--ready-timeout", "-1"), "--ready-timeout -1.0 is not > 0 s"),
    ("fuzz", ("files", "--cases", "file"), "--cases file: cannot be written: Not a directory"),
    ("topic", ("hz", "/imu/data_raw", "--window", "-1"), "-1 is not >= 1"),
    ("topic", ("echo", "/odometry", "-n", "0"), "0 is not >= 1"),
    ("topic", ("pub", "/x", "std_msgs/msg/Empty", "--rate", "0"), "0 is not a number > 0"),
    ("topic", ("list", "--spin-time", "nan"), "nan is not a number > 0"),
])
def test_what_cannot_be_is_refused(run, capsys, name, arguments, words):
    with pytest.raises(SystemExit) as end:
        run(name, *arguments)
    said = capsys.readouterr().err
    assert end.value.code == 2 and words in said.splitlines()[-1]


@pytest.mark.parametrize("name, arguments", [
    ("start_stack", ("--ready-timeout", "20")),
    ("topic", ("hz", "/imu/data_raw", "--window", "500", "-n", "3")),
])
def test_what_can_be_is_accepted(run, name, arguments):
    with pytest.raises(Entered):
        run(name, *arguments)
    assert [path.name for path in Path().iterdir()] == ["file"]  # nothing is left of the trial


@pytest.mark.parametrize("error, code, advice", [
    (GraphError("service /arm does not exist"), 2, ""),
    (NoAnswerError("/arm: no answer within 30 s"), 1, ". Is the stack ready? Wait until start_stack.py prints `ready`, then try again.")])
def test_a_name_that_does_not_exist_is_a_wrong_argument_and_silence_is_a_failure(monkeypatch, capsys, error, code, advice):
    def fail(*_):
        raise error

    monkeypatch.setattr(commands, "enter", lambda: None)
    monkeypatch.setattr("ros_graph.connection.connect", nullcontext)
    monkeypatch.setattr("ros_graph.calls.call_service", fail)
    monkeypatch.setattr(sys, "argv", ["service.py", "call", "/arm", "std_srvs/srv/SetBool"])
    assert commands.carry_out(service.command_line()) == code
    assert capsys.readouterr().err == f"error: {error}{advice}\n"


@pytest.fixture
def run_bench(monkeypatch):
    """Runs `bench.py` with words of a command line; `sim` breaks, the other groups call a function."""
    def run_(figures, *arguments: str) -> int:
        monkeypatch.setattr(bench, "enter", lambda: None)
        monkeypatch.setattr("importlib.import_module", lambda name: SimpleNamespace(
            figures=(lambda quick: 1 / 0) if name == "sim" else figures, SEEDS=f"of {name}"))
        monkeypatch.setattr(sys, "path", [*sys.path])
        monkeypatch.setattr(sys, "argv", ["bench.py", *arguments])
        return bench.main()

    return run_


def test_ctrl_c_ends_all_benchmarks_and_what_one_of_them_has_started_or_written(run_bench, tmp_path):
    def interrupted(quick):
        with tempfile.TemporaryDirectory(dir=tmp_path):
            signal.raise_signal(signal.SIGINT)

    assert run_bench(interrupted) == 130 and not [*tmp_path.iterdir()]


def test_a_group_that_breaks_hides_no_figures_and_is_named_in_the_file(run_bench, tmp_path, capsys):
    assert run_bench(lambda quick: [harness.figure("one", "ms", [1.0], bar=2.0)], "--json", str(tmp_path / "out.json")) == 1
    written = json.loads((tmp_path / "out.json").read_text())
    assert written["errors"] == {"sim": "ZeroDivisionError: division by zero"} and "error: sim: ZeroDivisionError" in capsys.readouterr().err
    others = [group for group in bench.GROUPS if group != "sim"]
    assert [one["group"] for one in written["figures"]] == others and written["seeds"] == {group: f"of {group}" for group in others}
    assert written["machine"]["cores"] >= 1 and written["command"].startswith("python3 bench.py --json")


@pytest.mark.parametrize("median, code", [(1.0, 0), (3.0, 1)])
def test_a_benchmark_fails_where_a_required_value_is_not_met(run_bench, median, code):
    assert run_bench(lambda quick: [harness.figure("one", "ms", [median], bar=2.0)], "planner") == code


def test_a_benchmark_does_not_replace_a_device_or_pipe(run_bench, tmp_path, capsys):
    os.mkfifo(tmp_path / "pipe")
    assert run_bench(None, "planner", "--json", str(tmp_path / "pipe")) == 2
    assert f"error: --json: {tmp_path / 'pipe'}: is no regular file" in capsys.readouterr().err and (tmp_path / "pipe").is_fifo()


@pytest.mark.parametrize("file", ["file/figures.json", "."])
def test_a_benchmark_whose_file_cannot_be_written_does_not_begin(run_bench, monkeypatch, tmp_path, capsys, file):
    monkeypatch.chdir(tmp_path)
    Path("file").touch()
    assert run_bench(None, "planner", "--json", file) == 2
    assert f"error: --json: {file}: cannot be written: " in capsys.readouterr().err and os.listdir() == ["file"]


@pytest.mark.parametrize("script", ["topic", "param", "service", "action"])
def test_each_sub_command_has_an_example_in_its_help(script):
    parser = importlib.import_module(script).command_line()
    verbs = next(action.choices for action in parser._actions if isinstance(action, argparse._SubParsersAction))
    for name, command in verbs.items():
        assert f"python3 scripts/{script}.py {name} " in command.format_help(), name


# -- output ----------------------------------------------------------------------------------------------------------


def test_a_stack_whose_output_nobody_reads_any_more_goes_on():
    """`... | tee` ends by Ctrl-C as well: a reader of a node's output that broke off would end the node while it finishes its recording."""
    program = f"import sys; sys.path.insert(0, {str(SCRIPTS)!r}); import start_stack as s; show = s.printer(['vehicle']); [show('vehicle', 'x') for _ in '12']"
    reading, writing = os.pipe()
    os.close(reading)
    done = subprocess.run([sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (0, "")


# -- nodes -----------------------------------------------------------------------------------------------------------

class Became(Exception):
    """The process would have become this program."""


@pytest.mark.parametrize("node, package", [("betaflight", "perch_autopilot"), ("mavlink", "perch_autopilot"), ("controller", "perch_control")])
def test_every_node_can_be_started_without_the_ros2_command(node, package, monkeypatch, tmp_path):
    def exec_program(path: str, words: list[str]) -> None:
        raise Became(path, words)

    monkeypatch.syspath_prepend(str(SCRIPTS))
    spec = importlib.util.spec_from_file_location("script_run_node", SCRIPTS / "run_node.py")
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    monkeypatch.setattr(script, "enter", lambda *_: None)
    monkeypatch.setattr(script, "exec_program", exec_program)
    monkeypatch.setattr(sys, "argv", ["run_node.py", node, "--ros-args", "-p", "link:=/dev/ttyACM0"])
    monkeypatch.setenv("PERCH_CONFIG_DIR", str(tmp_path))
    (tmp_path / f"{node}.yaml").touch()
    with pytest.raises(Became) as started:
        script.main()
    path, words = started.value.args
    assert Path(path).name == node and Path(path).parent.name == package and words[-1] == "link:=/dev/ttyACM0"
    assert words[1:4] == ["--ros-args", "--params-file", str(tmp_path / f"{node}.yaml")]


@pytest.mark.parametrize("closed, work, code, words", [
    (True, "print('x' * 10**6)", 1, ""), (True, "print('x')", 1, ""), (False, "os.write(broken, b'x')", 2, "error: Broken pipe\n")])
def test_a_command_whose_output_is_closed_ends_quietly_and_another_broken_pipe_is_an_error(closed, work, code, words):
    program = f"""
import argparse, os, sys
from perch_eval.arguments import command
reading, broken = os.pipe()
os.close(reading)
sys.exit(command(argparse.ArgumentParser, lambda _: {work} or 0)([]))"""
    reading, writing = os.pipe()
    if closed:
        os.close(reading)
    done = subprocess.run([sys.executable, "-c", program], stdout=writing, stderr=subprocess.PIPE, text=True)
    os.close(writing)
    assert (done.returncode, done.stderr) == (code, words)


def test_a_folder_of_results_belongs_to_one_process_at_a_time(tmp_path):
    # the nodes of both would read the parameters that the second one has written
    assert output_folder(tmp_path / "out") == output_folder(tmp_path / "out")
    program = ("import argparse, sys; from pathlib import Path; from perch_eval.arguments import command, output_folder; "
               "sys.exit(command(argparse.ArgumentParser, lambda _: 0 * len(str(output_folder(Path(sys.argv[1])))))([]))")

    def another(folder):
        return subprocess.run([sys.executable, "-c", program, str(folder)], capture_output=True, text=True)

    refused = another(tmp_path / "out")
    assert refused.returncode == 2 and "another run is writing there" in refused.stderr and len(refused.stderr.splitlines()) == 1
    assert another(tmp_path / "other").returncode == another(tmp_path / "other").returncode == 0  # its end is the end of the lock
    with locked_folder(tmp_path / "other"), locked_folder(tmp_path / "out"):
        assert another(tmp_path / "other").returncode == 2
    assert another(tmp_path / "other").returncode == 0 and another(tmp_path / "out").returncode == 2, "only what was locked here is released"
