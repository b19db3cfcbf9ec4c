"""Make sensor files from calibrations, and check recordings against them."""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from perch_core import so3
from perch_core.errors import ConfigError
from perch_core.sensors import Sensors, load_sensors
from perch_eval.arguments import command, command_parser, output_file
from perch_eval.recordings.calibration import from_asl, from_kalibr, to_yaml
from perch_eval.recordings.check import check
from perch_eval.recordings.opening import open_recording
from perch_eval.recordings.recording import root_of

EXAMPLES = """examples:
  python3 scripts/sensors.py import kalibr camchain-imucam.yaml imu.yaml --out mine.yaml
  python3 scripts/sensors.py import euroc V1_01_easy --out euroc.yaml
  python3 scripts/sensors.py import kalibr camchain-imucam.yaml imu.yaml --rename cam0=down cam1=front --imu-orientation 0 0.7071 0 0.7071
  python3 scripts/sensors.py check flight.mcap --sensors mine.yaml

exit code: 0 done (nothing would fail), 1 something would make perception fail, 2 invalid input, 130 interrupted"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("sensors.py", __doc__, EXAMPLES)
    verbs = out.add_subparsers(dest="verb", required=True, metavar="import|check")
    read = verbs.add_parser("import", help="make a sensor file from a calibration", epilog=EXAMPLES,
                            formatter_class=argparse.RawDescriptionHelpFormatter)
    read.set_defaults(work=_import)
    read.add_argument("kind", choices=("kalibr", "euroc"))
    read.add_argument("files", nargs="+", type=Path, metavar="FILE",
                      help="kalibr: camchain-imucam.yaml [imu.yaml]; euroc: the recording's folder")
    read.add_argument("--out", type=Path, metavar="FILE", help="where to write (default: the terminal)")
    read.add_argument("--name", help="name of the sensors (default: that of the file that is written)")
    read.add_argument("--rename", nargs="+", default=[], metavar="OLD=NEW", help="names of the cameras, as cam0=down")
    read.add_argument("--imu-orientation", nargs=4, type=float, default=(0.0, 0.0, 0.0, 1.0), metavar=("X", "Y", "Z", "W"),
                      help="axes of the IMU in the body (forward, left, up), as a quaternion (default: the body has the IMU's axes)")
    check_parser = verbs.add_parser("check", help="find what would make perception fail on a recording")
    check_parser.set_defaults(work=_check)
    check_parser.add_argument("recording", type=Path, metavar="RECORDING")
    check_parser.add_argument("--sensors", metavar="FILE",
                       help="sensor file, or its name in config/sensors (default: the recording's own calibration)")
    return out


def _import(args: argparse.Namespace) -> int:
    q = np.array(args.imu_orientation)
    if not abs(np.linalg.norm(q) - 1.0) < 1e-2:
        raise ConfigError("--imu-orientation", " ".join(map(str, args.imu_orientation)), "is no unit quaternion")
    R_BI, first = so3.quat_to_matrix(q / np.linalg.norm(q)), args.files[0]
    if args.kind == "kalibr":
        if len(args.files) > 2:
            raise ConfigError("import kalibr", str(args.files[2]), "is one file too many: camchain-imucam.yaml [imu.yaml]")
        sensors = from_kalibr(first, args.files[1] if len(args.files) > 1 else None, args.name or (args.out or first).stem, R_BI)
    else:
        root = root_of(first)
        if root is None or len(args.files) > 1:
            raise ConfigError("import euroc", str(args.files[-1]), "is no folder with mav0/cam0")
        sensors = from_asl(root, R_BI)
    comment = (f"Made by `scripts/sensors.py import {args.kind}` of {', '.join(file.name for file in args.files)}.\n"
               "1 sigma of the calibration (`sigma`) are defaults: see the calibration report.")
    if sensors.imu is not None:
        comment += (f"\naccel_bias of imu, 1 sigma, is {sensors.imu.accel_bias:g} m/s^2 by default: put the data sheet's zero-g offset there."
                    f"\ngyro_bias of imu, 1 sigma, is {sensors.imu.gyro_bias:g} rad/s by default: put the data sheet's zero-rate offset there.")
    text = to_yaml(_renamed(sensors, args), comment)
    if args.out is None:
        print(text, end="")
    else:
        with output_file(args.out) as draft:
            draft.write_text(text)
        load_sensors(args.out)
        print(f"sensor file: {args.out}")
    return 0


def _renamed(sensors: Sensors, args: argparse.Namespace) -> Sensors:
    """Return the sensors with the names of the command line."""
    names = dict(pair.split("=", 1) if "=" in pair else (pair, "") for pair in args.rename)
    for old, new in names.items():
        if old not in sensors.cameras or not new.isidentifier():
            raise ConfigError("--rename", f"{old}={new}", f"is not OLD=NEW with one of {', '.join(sensors.cameras)}")
    if len({names.get(name, name) for name in sensors.cameras}) < len(sensors.cameras) or len(names) < len(args.rename):
        raise ConfigError("--rename", " ".join(args.rename), "gives one name to two cameras, or two to one")
    cameras = {names.get(name, name): camera for name, camera in sensors.cameras.items()}
    return replace(sensors, cameras=cameras, name=args.name or sensors.name)


def _check(args: argparse.Namespace) -> int:
    recording = open_recording(args.recording, load_sensors(args.sensors) if args.sensors else None)
    found = check(recording, recording.read())
    width = max(len(finding.about) for finding in found.findings)
    for finding in found.findings:
        print(f"{finding.level:8} {finding.about:{width}}  {finding.text}")
    return 1 if found.fails else 0


main = command(parser, lambda args: args.work(args))
