"""Set-up: what it refuses, what it remembers, and that nothing is installed at a floating version."""

from __future__ import annotations

import ctypes
import importlib
import os
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from contextlib import nullcontext
from pathlib import Path

import perch_setup
import pytest
from perch_core.errors import PerchError
from perch_eval import extras
from perch_setup import lock as locking
from perch_setup import machine, progress, slim, stamps, virtualenv, wheel_paths, workspace
from perch_setup.environment import variables
from perch_setup.errors import SetupError
from perch_setup.layout import EXTRAS, REQUIREMENTS, ROOT
from perch_setup.machine import INSTALLED, WHEELS, check_python, check_tools, detect_platform


prepare = importlib.import_module("perch_setup.prepare")  # the package has a function of this name


def pins(name: str) -> dict[str, str]:
    """Package -> version of a lock file; every line must pin one version."""
    found = {}
    for line in (REQUIREMENTS / name).read_text().splitlines():
        if line and not line.startswith("#"):
            match = re.fullmatch(r"([a-z0-9][a-z0-9.-]*)==([^\s;]+)(; .*)?", line)
            assert match, f"{name}: {line!r} is not an exact version"
            found[match[1]] = match[2]
    return found


@pytest.fixture
def repository(tmp_path, monkeypatch) -> Path:
    """An empty repository in place of ours."""
    monkeypatch.setattr(stamps, "ROOT", tmp_path)
    monkeypatch.setattr(stamps, "STATE", tmp_path / ".perch")
    monkeypatch.setattr(stamps, "_FILE", tmp_path / ".perch" / "stamps.json")
    return tmp_path


# -- the machine -----------------------------------------------------------------------------------------------------


def test_wheels_without_ros_and_the_installation_where_jazzy_is_sourced(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "ROS_PREFIX", tmp_path / "ros_prefix")
    (tmp_path / "opt" / "share" / "rclpy").mkdir(parents=True)
    assert detect_platform({}) is WHEELS
    assert detect_platform({"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": f"{ROOT}/.venv:{tmp_path}/opt"}) is INSTALLED
    assert WHEELS.locks != INSTALLED.locks


@pytest.mark.parametrize("prefixes", ["", "/nowhere", f"{ROOT}/.venv"])
def test_a_distribution_that_is_named_and_not_there_replaces_nothing(prefixes):
    with pytest.raises(SetupError, match="no folder of AMENT_PREFIX_PATH has rclpy.*unset ROS_DISTRO") as error:
        detect_platform({"ROS_DISTRO": "jazzy", "AMENT_PREFIX_PATH": prefixes})
    assert error.value.exit_code == 2 and "\n" not in str(error.value)


def test_a_checkout_that_was_moved_says_why_it_is_set_up_again(repository, monkeypatch, capsys):
    installed = []
    monkeypatch.setattr(prepare, "ROOT", repository)
    monkeypatch.setattr(prepare.stamps, "environment_stamp", lambda wanted: "stamp")
    monkeypatch.setattr(prepare.virtualenv, "usable", lambda: True)
    monkeypatch.setattr(prepare.virtualenv, "install", lambda wanted, fresh: installed.append(fresh))
    monkeypatch.setattr(prepare, "record_installation", lambda wanted: None)
    prepare._install(WHEELS, {"identity": "wheels in /old/place"})
    assert installed == [True] and f"wheels in /old/place, and is now with ROS from wheels in {repository}" in capsys.readouterr().err
    prepare._install(WHEELS, {"identity": f"wheels in {repository}"})
    assert installed == [True, False] and capsys.readouterr().err == ""


@pytest.mark.parametrize("fits", [True, False])
def test_starting_from_nothing_removes_nothing_before_it_is_known_to_be_possible_and_is_noted(repository, monkeypatch, fits):
    """What is killed while it removes an environment is not taken for a finished set-up."""
    seen = []
    monkeypatch.setattr(prepare, "check_tools", lambda: None)
    monkeypatch.setattr(prepare, "detect_platform", lambda: WHEELS)
    monkeypatch.setattr(prepare, "setup_lock", nullcontext)
    monkeypatch.setattr(prepare.stamps, "environment_stamp", lambda wanted: "2")
    monkeypatch.setattr(prepare, "check_python", lambda wanted: None if fits else machine.check_python(wanted, (3, 13)))

    def install(wanted, fresh):
        seen.append((fresh, stamps.load()))
        raise SetupError("killed")

    monkeypatch.setattr(prepare.virtualenv, "install", install)
    stamps.save({"environment": "1"})
    with pytest.raises(SetupError, match="killed" if fits else "needs Python"):
        prepare.prepare(clean=True)
    assert seen == ([(True, {})] if fits else [])
    assert stamps.load() == ({} if fits else {"environment": "1"})


def test_a_workspace_stays_with_its_installation_in_shells_where_nothing_is_sourced(monkeypatch, tmp_path):
    monkeypatch.setattr(machine, "ROS_PREFIX", tmp_path / "ros_prefix")
    prefix = tmp_path / "opt"
    (prefix / "share" / "rclpy").mkdir(parents=True)
    (prefix / "setup.bash").touch()
    machine.record_installation(INSTALLED, {"AMENT_PREFIX_PATH": f"/overlay:{prefix}"})
    assert detect_platform({}) is INSTALLED
    (prefix / "setup.bash").unlink()
    assert detect_platform({}) is WHEELS


def test_another_distribution_is_refused_with_a_way_out():
    with pytest.raises(SetupError, match="ROS 2 humble is sourced.*perch needs jazzy.*source /opt/ros/jazzy") as error:
        detect_platform({"ROS_DISTRO": "humble"})
    assert error.value.exit_code == 2 and "\n" not in str(error.value)


@pytest.mark.parametrize("version", [(3, 8), (3, 10), (3, 13), (4, 0)])
def test_an_unsupported_python_is_named_with_the_supported_ones(version):
    with pytest.raises(SetupError, match=r"needs Python 3\.11 or 3\.12") as error:
        check_python(WHEELS, version)
    assert "{}.{}".format(*version) in str(error.value) and error.value.exit_code == 2


def test_a_processor_without_wheels_is_refused_unless_ros_is_installed(monkeypatch, tmp_path):
    monkeypatch.delenv("AMENT_PREFIX_PATH", raising=False)
    monkeypatch.setattr(machine, "ROS_PREFIX", tmp_path / "ros_prefix")
    monkeypatch.setattr(machine.platform, "machine", lambda: "aarch64")
    with pytest.raises(SetupError, match="aarch64.*install ROS 2 Jazzy"):
        check_python(WHEELS, (3, 12))
    check_python(INSTALLED, (3, 12))


def test_a_python_that_is_not_that_of_the_installation_is_refused(monkeypatch, tmp_path):
    for folder in ("share/rclpy", "lib/python3.12/site-packages/rclpy"):
        (tmp_path / folder).mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    with pytest.raises(SetupError, match=f"{tmp_path} is not for Python 3.11"):
        check_python(INSTALLED, (3, 11))
    check_python(INSTALLED, (3, 12))


@pytest.mark.parametrize("name", ["my perch", "a:b"])
def test_a_checkout_in_which_no_executable_would_start_is_refused(monkeypatch, name):
    monkeypatch.setattr(machine, "ROOT", Path("/work", name))
    with pytest.raises(SetupError, match="move the checkout"):
        check_python(WHEELS, (3, 11))


def test_each_missing_tool_is_named_with_its_apt_line(monkeypatch):
    monkeypatch.setattr(machine.shutil, "which", lambda tool: None if tool in ("cmake", "g++") else f"/usr/bin/{tool}")
    monkeypatch.setattr(machine.importlib.util, "find_spec", lambda name: None)
    monkeypatch.setattr(machine.sysconfig, "get_paths", lambda: {"include": "/nowhere"})
    with pytest.raises(SetupError) as error:
        check_tools()
    text = str(error.value)
    assert "sudo apt-get install cmake g++ python3" in text and "-venv" in text and "-dev" in text
    assert " make" not in text.split("install ")[1]


@pytest.mark.parametrize("domain", ["abc", "233", "-1"])
def test_a_domain_that_ros_cannot_have_is_refused(monkeypatch, domain):
    monkeypatch.setenv("ROS_DOMAIN_ID", domain)
    with pytest.raises(SetupError, match=f"ROS_DOMAIN_ID={domain} is not a number from 0 to 232") as error:
        variables(WHEELS)
    assert error.value.exit_code == 2


def sourced(folder: Path, wheels: bool, **variables: str) -> subprocess.CompletedProcess[str]:
    """`setup.bash` sourced in a set-up folder, which prints the range of discovery."""
    shutil.copy(ROOT / "setup.bash", folder)
    for file in (".venv/bin/activate", "install/setup.bash", *[".venv/share/rclpy/package.xml"] * wheels):
        (folder / file).parent.mkdir(parents=True, exist_ok=True)
        (folder / file).touch()
    return subprocess.run(["bash", "--norc", "-c", 'source "$1/setup.bash" && echo "$ROS_AUTOMATIC_DISCOVERY_RANGE"', "bash", str(folder)],
                          env={"PATH": os.environ["PATH"], **variables}, capture_output=True, text=True)


@pytest.mark.parametrize("wheels", [True, False])
@pytest.mark.parametrize("middleware, limit", [("", "SUBNET"), ("rmw_fastrtps_cpp", "SUBNET"), ("rmw_cyclonedds_cpp", "LOCALHOST")])
def test_another_middleware_is_refused_where_there_is_none_and_else_does_not_search_the_network(tmp_path, wheels, middleware, limit):
    """The address of `config/fastdds.xml` is a setting of Fast DDS."""
    done = sourced(tmp_path, wheels, RMW_IMPLEMENTATION=middleware)
    if wheels and limit == "LOCALHOST":
        assert done.returncode == 1 and "the ROS wheels have rmw_fastrtps_cpp only: run   unset RMW_IMPLEMENTATION" in done.stderr
    else:
        assert (done.returncode, done.stdout) == (0, f"{limit}\n"), done.stderr


@pytest.mark.parametrize("address, good", [
    ("", True), ("10.0.0.255", True), ("127.0.0.1.", False), ("127.0.0", False), ("256.0.0.1", False), ("localhost", False)])
def test_an_address_that_fast_dds_cannot_read_is_refused(tmp_path, address, good):
    done = sourced(tmp_path, True, PERCH_NETWORK=address)
    assert done.returncode == (not good) and ("is not an address such as 127.0.0.1" in done.stderr) is not good


# -- the locks -------------------------------------------------------------------------------------------------------


def test_locks_pin_every_package_and_agree_with_each_other():
    for base in (["ros.lock", "python.lock"], ["python-ros-jazzy.lock"]):
        together = Counter(set().union(*(pins(lock).items() for lock in [*base, *(f"extras/{extra}.lock" for extra in EXTRAS)])))
        assert Counter(name for name, _ in together).most_common(1)[0][1] == 1


@pytest.mark.parametrize("lock", ["python.lock", "python-ros-jazzy.lock"])
def test_locks_hold_everything_that_perch_asks_for(lock):
    flight, *extras = re.split(r"^# extra (\w+):.*\n", (REQUIREMENTS / "python.in").read_text(), flags=re.MULTILINE)
    asked = {lock: flight} | {f"extras/{name}.lock": text for name, text in zip(extras[::2], extras[1::2])}
    assert len(asked) == 1 + len(EXTRAS)
    for name, text in asked.items():
        assert set(re.findall(r"^([a-z][a-z0-9-]*)", text, re.MULTILINE)) <= set(pins(name))


def test_the_lock_for_an_installation_leaves_ros_alone_and_fits_its_binaries():
    lock = pins("python-ros-jazzy.lock")
    assert not [name for name in lock if name.startswith(("ros-", "ament-", "lark"))]
    assert lock["numpy"].startswith("1.26.") and lock["empy"].startswith("3.")


def test_both_ways_to_ros_run_the_same_packages():
    wheels, installed = pins("python.lock"), pins("python-ros-jazzy.lock")
    assert {name for name in wheels if installed[name] != wheels[name]} == {"numpy", "pytest"}


@pytest.mark.skipif(not (Path(sys.prefix) / "share" / "rclpy").exists(), reason="ROS is installed, not from wheels")
def test_the_locks_are_complete_and_fit_together():
    # packages are installed without resolving dependencies
    result = subprocess.run([sys.executable, "-m", "pip", "check"], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout


# -- stamps ----------------------------------------------------------------------------------------------------------


def test_only_what_the_build_reads_changes_a_package_stamp(repository):
    package = repository / "src" / "perch_x"
    for folder in ("msg", "config", "perch_x"):
        (package / folder).mkdir(parents=True)
    (package / "setup.py").write_text("setup()")
    (package / "msg" / "A.msg").write_text("float64 x")
    (package / "perch_x" / "code.py").write_text("")
    (package / "config" / "one.yaml").write_text("a: 1")
    seen = [stamps.package_stamp(package, "environment")]

    (package / "perch_x" / "code.py").write_text("print()")
    (package / "config" / "one.yaml").write_text("a: 2")
    assert stamps.package_stamp(package, "environment") == seen[0]

    for name, text in (("setup.py", "setup(1)"), ("msg/A.msg", "float64 y"), ("msg/B.msg", ""), ("config/two.yaml", "")):
        (package / name).write_text(text)
        seen.append(stamps.package_stamp(package, "environment"))
    seen.append(stamps.package_stamp(package, "another environment"))
    assert len(set(seen)) == len(seen)


def test_a_constant_that_kernels_import_changes_their_stamp_and_other_files_do_not(repository, monkeypatch):
    monkeypatch.setattr(stamps, "SOURCES", repository / "src")
    package = repository / "src" / "perch_x" / "perch_x"
    package.mkdir(parents=True)
    (package / "kernels.py").write_text("from perch_x.vehicle import GRAVITY, Vehicle\nfrom perch_x.files import read\n@compiled\ndef fall(): ...\n")
    (package / "vehicle.py").write_text("from perch_x.planet import (\n    G,\n    MASS)\nGRAVITY = G * MASS\n")
    (package / "planet.py").write_text("G, MASS = 1.0, 9.81\n")
    (package / "files.py").write_text("def read(): ...\n")
    seen = [stamps.kernel_stamp("environment")]
    (package / "files.py").write_text("def read(): return 1\n")
    assert stamps.kernel_stamp("environment") == seen[0]
    (package / ".#files.py").symlink_to("somebody@somewhere.1")  # Emacs's lock of a file that is being edited
    for name in ("planet.py", "vehicle.py", "kernels.py"):
        (package / name).write_text((package / name).read_text() + "\n")
        seen.append(stamps.kernel_stamp("environment"))
    assert len(set(seen)) == len(seen)


def test_stamps_survive_and_a_damaged_file_means_nothing_is_done(repository):
    stamps.save({"perch_x": "1"})
    assert stamps.load() == {"perch_x": "1"}
    (repository / ".perch" / "stamps.json").write_text('{"perch_x": "1"')
    assert stamps.load() == {}
    (repository / ".perch" / "stamps.json").write_text("[]")
    assert stamps.load() == {}


@pytest.fixture
def environment(tmp_path, monkeypatch) -> Path:
    """A finished environment in place of ours."""
    python = tmp_path / ".venv" / "bin" / "python"
    monkeypatch.setattr(virtualenv, "VENV", tmp_path / ".venv")
    monkeypatch.setattr(virtualenv, "VENV_PYTHON", python)
    monkeypatch.setattr(virtualenv, "STATE", tmp_path)
    monkeypatch.setattr(virtualenv, "_UNFINISHED", tmp_path / "installing")
    python.parent.mkdir(parents=True)
    python.touch()
    (python.parent / "activate").touch()
    assert virtualenv.usable()
    return python.parent


def test_an_environment_whose_creation_was_interrupted_is_not_used(environment):
    (environment / "activate").unlink()
    assert not virtualenv.usable()


def test_an_environment_whose_python_was_upgraded_is_not_used(environment):
    for version in ("python3.11", "python3.13"):
        (environment / version).touch()
    (environment.parent / "lib" / "python3.11").mkdir(parents=True)
    for version, usable in (("python3.11", True), ("python3.13", False)):
        (environment / "python").unlink()
        (environment / "python").symlink_to(environment / version)
        assert virtualenv.usable() is usable


@pytest.mark.parametrize("tool", ["venv", "pip"])
def test_an_environment_that_is_killed_at_any_step_is_made_anew(environment, monkeypatch, tool):
    class Killed(BaseException):
        pass

    def run(self, command, name, *_):
        environment.mkdir(parents=True, exist_ok=True)
        for file in ("python", "activate"):  # all that tells an environment is there
            (environment / file).touch()
        if name == tool:
            raise Killed

    monkeypatch.setattr(progress.Step, "run", run)
    with pytest.raises(Killed):
        virtualenv.install(WHEELS, fresh=True)
    assert not virtualenv.usable()


@pytest.mark.parametrize("lines, kept", [(["Collecting numpy==1"], True), (["Collecting numpy==1", "Installing collected packages: numpy"], False)])
def test_an_environment_is_kept_where_its_new_packages_cannot_be_fetched(environment, monkeypatch, lines, kept):
    """Without network a checkout goes on with the commit before; what a failure has changed is made anew."""
    def run(self, command, name, variables, describe):
        for line in lines:
            describe(line)
        raise SetupError("no network", 1)

    monkeypatch.setattr(progress.Step, "run", run)
    with pytest.raises(SetupError, match="no network"):
        virtualenv.install(WHEELS, fresh=False)
    assert virtualenv.usable() is kept


def test_pip_is_not_quiet_where_the_user_has_set_that(monkeypatch):
    """What it prints tells when it begins to change the environment."""
    monkeypatch.setenv("PIP_QUIET", "1")
    assert virtualenv._environment(WHEELS)["PIP_QUIET"] == "0"


@pytest.fixture
def pip(environment, tmp_path, monkeypatch) -> list[list[str]]:
    """The command lines of pip, which does nothing."""
    called: list[list[str]] = []
    monkeypatch.setattr(stamps, "_FILE", tmp_path / "stamps.json")
    monkeypatch.setattr(progress.Step, "run", lambda self, command, name, *_: called.append([str(word) for word in command]))
    return called


def test_an_extra_is_installed_once_and_again_in_a_new_environment(pip, monkeypatch):
    done = {"environment": "1"}
    for _ in range(2):
        prepare._install_extras(WHEELS, done, ["view"])
    assert len(pip) == 1 and pip[0][-1] == str(EXTRAS["view"])
    monkeypatch.setattr(virtualenv, "usable", lambda: False)
    monkeypatch.setattr(virtualenv, "install", lambda wanted, fresh: None)
    monkeypatch.setattr(prepare, "record_installation", lambda wanted: None)
    prepare._install(WHEELS, done)
    prepare._install_extras(WHEELS, done, ["view"])
    assert len(pip) == 2


def test_an_extra_that_cannot_be_installed_is_named_with_the_command_and_then_repaired(pip, monkeypatch):
    record = progress.Step.run

    def offline(*_):
        raise SetupError("no network", 1)

    monkeypatch.setattr(progress.Step, "run", offline)
    done = {"environment": "1"}
    with pytest.raises(SetupError, match="scripts/setup.py --extra recordings'.*\n*no network") as error:
        prepare._install_extras(WHEELS, done, ["recordings"])
    assert error.value.exit_code == 2 and virtualenv.usable()  # flights go on
    monkeypatch.setattr(progress.Step, "run", record)
    prepare._install_extras(WHEELS, done, ["recordings"])
    assert "--ignore-installed" in pip[0]  # what a killed pip left is no package


def test_a_node_whose_extra_is_missing_says_which_command_installs_it(monkeypatch):
    monkeypatch.setitem(extras.MODULES, "view", ("no_such_module",))
    with pytest.raises(PerchError, match="scripts/setup.py --extra view"):
        extras.require("view")


def test_a_package_is_built_from_an_empty_folder(tmp_path, monkeypatch):
    # what CMake generated for a message that has gone stays linked into the typesupport of the others
    monkeypatch.setattr(workspace, "BUILD", tmp_path / "build")
    monkeypatch.setattr(workspace, "INSTALL", tmp_path / "install")
    monkeypatch.setattr(workspace, "_environment", lambda wanted: {})
    monkeypatch.setattr(progress.Step, "run", lambda *_: None)
    for package in ("perch_x", "perch_y"):
        (tmp_path / "build" / package).mkdir(parents=True)
    workspace.build([tmp_path / "src" / "perch_x"], WHEELS, fresh=False)
    assert not (tmp_path / "build" / "perch_x").exists() and (tmp_path / "build" / "perch_y").exists()


@pytest.mark.parametrize("line, words", [
    ("Starting >>> perch_core\n", "perch_core"),
    ("[ 73%] Built target tf2_msgs__rosidl_typesupport_introspection_cpp\n", "tf2_msgs 73 %"),
    ("[  8%] Building C object CMakeFiles/perch_msgs__rosidl_generator_c.dir/perch_msgs/msg/detail/contact__functions.c.o\n", "perch_msgs 8 %"),
    ("[  1%] Generating C code for ROS interfaces\n", None),
])
def test_the_progress_of_a_build_names_the_package_it_is_of(line, words):
    assert workspace._progress(line) == words


# -- steps -----------------------------------------------------------------------------------------------------------


@pytest.fixture
def warm_up(tmp_path, monkeypatch):
    """What compiles the numerics: a module that tells of itself in a file, with `flight` waits for the end of the build, and needs no workspace."""
    (tmp_path / "standing_in.py").write_text(
        "import os, sys, time\n"
        "if sys.argv[1] == 'flight': import perch_planner; assert 'perch_msgs' not in sys.modules\n"
        f"open(r'{tmp_path}/' + sys.argv[1], 'w').close()\n"
        f"while sys.argv[1] == 'flight' and not os.path.exists(r'{tmp_path}/built'): time.sleep(0.01)\n"
        f"sys.exit(os.path.exists(r'{tmp_path}/spoiled_' + sys.argv[1]))\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(prepare, "WARM_UP", "standing_in")
    monkeypatch.setattr(prepare, "variables", lambda *_, **__: dict(os.environ))
    monkeypatch.setattr(progress, "STATE", tmp_path)
    monkeypatch.setattr(prepare.stamps, "save", lambda done: None)
    return tmp_path


def _wait_for(path):
    end = time.monotonic() + 120.0
    while not path.exists():
        assert time.monotonic() < end
        time.sleep(0.01)


def test_numerics_are_compiled_beside_the_build_and_after_it_and_once(warm_up):
    done = {"environment": "1"}
    with prepare._compiled(WHEELS, done):
        _wait_for(warm_up / "flight")
        assert not (warm_up / "nodes").exists() and "warmed" not in done
        (warm_up / "built").touch()
    assert (warm_up / "nodes").exists() and done["warmed"]
    (warm_up / "flight").unlink()
    with prepare._compiled(WHEELS, done):
        pass
    assert not (warm_up / "flight").exists()


def test_the_flight_beside_a_failing_build_ends_with_it(warm_up):
    done = {"environment": "1"}
    with pytest.raises(SetupError, match="the compiler"), prepare._compiled(WHEELS, done):
        _wait_for(warm_up / "flight")
        raise SetupError("the compiler failed")
    assert "warmed" not in done and not (warm_up / "nodes").exists()  # `Popen`'s context has waited for the end of the flight


@pytest.mark.parametrize("part", ["flight", "nodes"])
def test_numerics_that_could_not_be_compiled_are_mentioned_and_left_to_the_first_flight(warm_up, capsys, part):
    (warm_up / "built").touch(), (warm_up / f"spoiled_{part}").touch()
    done = {"environment": "1"}
    with prepare._compiled(WHEELS, done):
        pass
    assert "left to the first flight" in capsys.readouterr().err and done["warmed"]


def test_a_failing_tool_is_reported_with_its_last_lines_and_its_log(tmp_path, monkeypatch):
    monkeypatch.setattr(progress, "STATE", tmp_path)
    code = "print('first'); [print('line', i) for i in range(30)]; raise SystemExit(7)"
    with pytest.raises(SetupError, match="exit code 7") as error, progress.Step("test") as step:
        step.run([sys.executable, "-c", code], "tool", {})
    assert error.value.exit_code == 1
    assert "step tool" in str(error.value) and "line 29" in str(error.value) and "first" not in str(error.value)
    assert "first" in (tmp_path / "log" / "tool.log").read_text()


@pytest.mark.parametrize("error, words", [
    (PermissionError(13, "Permission denied", "/work/.perch/lock"), "[Errno 13] Permission denied: '/work/.perch/lock'"),
    (subprocess.CalledProcessError(1, "python"), "Command 'python' returned non-zero exit status 1.")])
def test_a_disk_that_is_full_or_a_python_that_does_not_run_ends_the_set_up_in_one_line(capsys, error, words):
    with pytest.raises(SystemExit) as end, perch_setup.setting_up():
        raise error
    assert end.value.code == 1 and capsys.readouterr().err == f"perch: set-up failed: {words}\n"


def test_progress_stays_on_one_line_of_a_narrow_terminal(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "40")
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    progress.Step("building").show("x" * 100)
    assert len(capsys.readouterr().err.removeprefix("\r\033[K")) == 39


def test_a_second_set_up_waits_for_the_first(tmp_path, monkeypatch):
    monkeypatch.setattr(locking, "STATE", tmp_path)
    code = (f"import sys, pathlib; sys.path.insert(0, {str(ROOT / 'scripts')!r}); from perch_setup import lock\n"
            f"lock.STATE = pathlib.Path({str(tmp_path)!r})\nwith lock.setup_lock(): print('inside', flush=True)")
    with locking.setup_lock():
        second = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        assert "waiting" in second.stderr.readline()
        assert second.poll() is None
    out, _ = second.communicate(timeout=60)
    assert out == "inside\n" and second.returncode == 0


def test_wheel_exports_lose_the_paths_of_the_machine_that_built_them():
    text = ('set_target_properties(a PROPERTIES INTERFACE_INCLUDE_DIRECTORIES "/opt/python/cp311-cp311/include/python3.11;'
            '/opt/python/cp311-cp311/lib/python3.11/site-packages/numpy/_core/include"\n  OTHER "${_IMPORT_PREFIX}/include")')
    repaired = wheel_paths.repair(text, "/usr/include/python3.11", "/venv/numpy")
    assert '"/usr/include/python3.11;/venv/numpy"' in repaired and '"${_IMPORT_PREFIX}/include"' in repaired
    assert wheel_paths.repair(repaired, "/usr/include/python3.11", "/venv/numpy") == repaired


def test_equal_libraries_under_several_names_become_one_file(tmp_path):
    for name, text in {"libb.so": "b", "liba.so": "a", "liba.so.3": "a", "liba.so.3.7": "a", "a.txt": "a"}.items():
        (tmp_path / name).write_text(1000 * text)
    assert [slim.link_copies(tmp_path) for _ in range(2)] == [2000, 0]
    assert (tmp_path / "liba.so").samefile(tmp_path / "liba.so.3.7") and (tmp_path / "liba.so.3").read_text() == 1000 * "a"
    assert (tmp_path / "libb.so").read_text() == 1000 * "b" and not (tmp_path / "a.txt").samefile(tmp_path / "liba.so")
    assert len(list(tmp_path.iterdir())) == 5


def test_what_nobody_uses_is_taken_out_of_the_packages(tmp_path):
    for name in ("casadi/include/a.h", "casadi/libb.a", "casadi/libb.so", "scipy/stats/tests/test_c.py", "scipy/stats/d.py", "mine/tests/e.py"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    for _ in range(2):
        slim.slim(tmp_path)
    assert sorted(file.name for file in tmp_path.rglob("*.*")) == ["d.py", "e.py", "libb.so"]


def test_symbols_of_a_debugger_are_taken_out_and_the_library_still_works(tmp_path):
    library = tmp_path / "lib.so"
    (tmp_path / "lib.c").write_text("static int unseen(int x) { return x + 1; } int seen(int x) { return unseen(x); }")
    subprocess.run(["g++", "-g", "-shared", "-fPIC", "-x", "c", "-o", library, tmp_path / "lib.c"], check=True)
    (tmp_path / "none.so").write_text("no library")
    before = library.stat()
    for _ in range(2):
        slim.slim(tmp_path)
    assert library.stat().st_size < before.st_size and library.stat().st_mode == before.st_mode
    assert ctypes.CDLL(str(library)).seen(1) == 2 and (tmp_path / "none.so").read_text() == "no library"
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.parametrize("platform, built", [(WHEELS, True), (INSTALLED, False)])
def test_only_an_installation_of_ros_takes_the_place_of_a_package_of_ours(tmp_path, monkeypatch, platform, built):
    """A shell in which another checkout is sourced has its `tf2_msgs`, which is not where this checkout looks for it."""
    (tmp_path / "share" / "tf2_msgs").mkdir(parents=True)
    monkeypatch.setenv("AMENT_PREFIX_PATH", str(tmp_path))
    names = {folder.name for folder in stamps.packages(platform)}
    assert ("tf2_msgs" in names) is built and {"perch_core", "perch_msgs"} <= names
    monkeypatch.delenv("AMENT_PREFIX_PATH")  # in a shell where nothing is sourced
    (tmp_path / "ros_prefix").write_text(str(tmp_path))
    (tmp_path / "setup.bash").touch()
    monkeypatch.setattr(machine, "ROS_PREFIX", tmp_path / "ros_prefix")
    assert names == {folder.name for folder in stamps.packages(platform)}
