"""Command line program `preflight`."""

from __future__ import annotations

import argparse
from contextlib import closing
from typing import Any

import numpy as np

from perch_control.modes import State
from perch_core.errors import PerchError
from perch_core.imu_axes import ImuAxes
from perch_core.sensors import Sensors, load_sensors
from perch_core.values import Command, ImuSample
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.arguments import command, command_parser
from perch_eval.preflight import checks
from perch_eval.preflight.checks import Check, Verdict

EXAMPLES = """examples:
  python3 scripts/preflight.py --vehicle mine.yaml                     listen for 5 s to a vehicle that stands still on its feet
  python3 scripts/preflight.py --vehicle mine.yaml --shake down        then rotate it by hand: rotation between camera and IMU
  python3 scripts/preflight.py --vehicle mine.yaml --props-off         then arm, disarm and kill: NO PROPELLERS MAY BE MOUNTED
  python3 scripts/preflight.py --vehicle mine.yaml --props-off --takeover   then wait until the pilot takes over by the switch
  python3 scripts/preflight.py --vehicle mine.yaml --props-off --watchdog   then wait until you stop the controller, and check that the motors stop

exit code: 0 nothing has failed, 1 something has, 2 wrong arguments"""
USER_TIMEOUT = 9.0   # for an action by hand: soon after, the armed controller stops the motors by itself [s]
REPORT_TIME = 1.5    # for the autopilot to report that it is disarmed, before which a KILL is not over: MAVLink's heartbeats come once a second [s]


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = command_parser("preflight.py", "Check a running vehicle before it flies.", EXAMPLES)
    out.add_argument("--vehicle", required=True, help="vehicle file, or its name in config/vehicles")
    out.add_argument("--sensors", default="", help="sensor file that its nodes are given: axes of the IMU, and its cameras in place of the vehicle's")
    out.add_argument("--namespace", default="", help="namespace of its nodes")
    out.add_argument("--listen", type=float, default=5.0, metavar="S", help="how long to listen (default: %(default)s)")
    out.add_argument("--shake", metavar="CAMERA",
                     help="name of the camera, for example down, whose rotation to the IMU is checked; rotate the vehicle by hand for 10 s when asked")
    out.add_argument("--props-off", action="store_true", help="no propellers are mounted: the motors may be started")
    out.add_argument("--takeover", action="store_true", help="with --props-off: the pilot will take over, with the pilot's arming switch off")
    out.add_argument("--watchdog", action="store_true", help="with --props-off: the controller will be stopped by hand")
    return out


def imu_in_body(listener: Any, sensors: str) -> list[ImuSample]:
    """Return the received IMU samples in the axes of B, rotated as in the nodes; without samples of unknown axes."""
    axes = ImuAxes(lambda *_: None, sensors)
    for _, transform in listener.values["/tf_static"]:
        axes.add_transform(transform)
    return [taken for _, sample in listener.values["imu/data_raw"] if (taken := axes.in_body(sample)) is not None]


def described_cameras(vehicle: Vehicle, sensors: str) -> Vehicle | Sensors:
    """Return what describes the cameras for the nodes: the sensor file if it has any, else the vehicle."""
    described = load_sensors(sensors) if sensors else None
    return described if described and described.cameras else vehicle


def passive_checks(listener: Any, vehicle: Vehicle, cameras: Vehicle | Sensors, sensors: str) -> list[Check]:
    """Return the checks of a vehicle at rest, with the cameras of `described_cameras`."""
    values = {channel: [value for _, value in entries] for channel, entries in listener.values.items()}
    silence = {f"camera_{name}/camera_info": checks.without_camera_info(cameras) for name in cameras.mounts}
    found = [check for channel in ("imu/data_raw", "odometry", *silence)
             for check in checks.check_stream(channel, [value.stamp for value in values[channel]], silence.get(channel, Verdict.FAILED))]
    frames = {name: listener.arrivals_and_stamps(f"camera_{name}/camera_info") for name in cameras.mounts}
    found += checks.check_clocks(listener.arrivals_and_stamps("imu/data_raw"), frames)
    imu = imu_in_body(listener, sensors)
    found += checks.check_frames(listener.newest("odometry"), listener.newest("imu/data_raw"), bool(imu))
    found += checks.check_at_rest(imu)
    found += [checks.check_camera_model(name, listener.newest(f"camera_{name}/camera_info"), cameras) for name in cameras.mounts]
    found += [Check(f"camera_{name}", Verdict.OPEN, f"not in {cameras.name}", "check it in a run without --sensors, if a node uses it")
              for name in vehicle.mounts if name not in cameras.mounts]
    return found + checks.check_extrinsics(values["/tf_static"], vehicle, cameras)


def rotation_check(listener: Any, cameras: Vehicle | Sensors, camera: str | None, sensors: str) -> Check:
    """Ask for the vehicle to be rotated and check the rotation between camera and IMU; without a camera it is not exercised."""
    turned = np.zeros((0, 3)), np.zeros((0, 3))
    if camera:
        listener.subscribe_camera(camera, cameras.mounts[camera].camera)
        print("rotate the vehicle back and forth about all axes for 10 s ...", flush=True)
        listener.spin_for(10.0)
        imu = imu_in_body(listener, sensors)
        turned = listener.turns.paired(np.array([s.stamp for s in imu]), np.array([s.w_B for s in imu]).reshape(-1, 3),
                                       cameras.mounts[camera].stamp_offset)
    return checks.check_rotation(camera or next(iter(cameras.mounts), ""), *turned, cameras)


def active_checks(listener: Any, arguments: argparse.Namespace, bound: float = checks.STOP_TIME) -> list[Check]:
    """Check arming, disarming, kill, the pilot's takeover and watchdog, with the props off; `bound`: see `checks.check_watchdog`.

    The motors are off at the end, also after an interrupt.
    """
    if not arguments.props_off:
        return [Check(name, Verdict.OPEN, "the motors were not started", "take the propellers off, and add --props-off")
                for name in ("armed state", "disarming", "kill", "pilot's takeover", "watchdog")]
    try:
        return _props_off_checks(listener, arguments, bound)
    finally:
        listener.send_command(Command.KILL, State.FAILED)
        listener.send_command(Command.DISARM, State.DISARMED)


def _props_off_checks(listener: Any, arguments: argparse.Namespace, bound: float) -> list[Check]:
    """Return the checks of `active_checks`; the controller may be left armed."""
    found = [checks.check_command("armed state", listener.send_command(Command.ARM, State.ARMED), State.ARMED, True),
             checks.check_command("disarming", listener.send_command(Command.DISARM, State.DISARMED), State.DISARMED, False)]
    takeover, watchdog = (False, None), (None, None)
    if found[0].verdict is Verdict.PASSED:
        listener.send_command(Command.ARM, State.ARMED)
        found.append(checks.check_command("kill", listener.send_command(Command.KILL, State.FAILED), State.FAILED, False))
        listener.send_command(Command.DISARM, State.DISARMED)
        listener.spin_for(REPORT_TIME)
        if arguments.takeover and listener.send_command(Command.ARM, State.ARMED).armed:
            print(f"armed: pilot, your arming switch off, then take over (within {USER_TIMEOUT:g} s) ...", flush=True)
            takeover = listener.await_takeover(USER_TIMEOUT)
            listener.send_command(Command.DISARM, State.DISARMED)
            print("disarmed: hand over again", flush=True)
    else:
        found.append(Check("kill", Verdict.OPEN, "the controller did not arm", "see armed state"))
    if arguments.watchdog and listener.send_command(Command.ARM, State.ARMED).armed:
        print(f"armed: stop the controller's process now (within {USER_TIMEOUT:g} s) ...", flush=True)
        watchdog = listener.await_end_of_commands(USER_TIMEOUT)
    return [*found, checks.check_takeover(*takeover), checks.check_watchdog(*watchdog, bound)]


def _check(arguments: argparse.Namespace) -> int:
    """Receive data, check them, and print the verdicts."""
    for name in ("takeover", "watchdog"):
        if getattr(arguments, name) and not arguments.props_off:
            raise PerchError(f"--{name} starts the motors: it needs --props-off")
    if not 1.0 <= arguments.listen <= 300.0:
        raise PerchError(f"--listen: {arguments.listen:g} is outside [1, 300] s")
    vehicle = load_vehicle(arguments.vehicle)
    cameras = described_cameras(vehicle, arguments.sensors)
    if arguments.shake and arguments.shake not in cameras.mounts:
        raise PerchError(f"--shake: {cameras.name} has no camera {arguments.shake!r}")
    from perch_eval.preflight.ros.listener import GraphListener

    with closing(GraphListener(vehicle, arguments.namespace, cameras.mounts)) as listener:
        print(f"listening for {arguments.listen:g} s: the vehicle must stand still on its feet ...", flush=True)
        listener.await_first("imu/data_raw", arguments.listen)
        listener.spin_for(arguments.listen)
        found = [*passive_checks(listener, vehicle, cameras, arguments.sensors),
                 rotation_check(listener, cameras, arguments.shake, arguments.sensors),
                 *active_checks(listener, arguments, checks.STOP_TIME if vehicle.actuation.type == "rotor_speeds" else checks.DESCENT_TIME)]
    print("\n".join(map(str, found)))
    counts = {verdict: sum(check.verdict is verdict for check in found) for verdict in Verdict}
    print(", ".join(f"{count} {verdict.value}" for verdict, count in counts.items()))
    return 1 if counts[Verdict.FAILED] else 0


main = command(parser, _check)
