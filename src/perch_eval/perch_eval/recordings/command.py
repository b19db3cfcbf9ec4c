"""Perception on a recording: VIO, estimator, target localiser and powerline mapper, with a report."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import so3
from perch_core.errors import ConfigError, PerchError
from perch_core.json_values import write_json
from perch_core.processes import one_thread_for_sums
from perch_core.sensors import Sensors, load_sensors
from perch_core.tag_board import load_board
from perch_core.values import CameraImage, InertialState, OdometryState
from perch_eval.arguments import command, command_parser, output_folder
from perch_eval.node_launch import parse_overrides
from perch_eval.recordings.calibration import to_yaml
from perch_eval.recordings.check import check
from perch_eval.recordings.evaluation import Evaluation, evaluate
from perch_eval.recordings.drawing import Gallery
from perch_eval.recordings.opening import open_recording
from perch_eval.recordings.perception import Perception
from perch_eval.recordings.pictures_seen import drawn, guessed_mount, look
from perch_eval.recordings.recording import Recording, RecordingError
from perch_eval.recordings.report import Told, bias_figure, error_figure, frames_figure, path_figure
from perch_eval.recordings.trajectory import Trajectory, read_truth, write_tum
from perch_perception.images import ImageError
from perch_perception.line_mapping import LineDetectionConfig

NODES = ("vio", "estimator", "target_localizer", "powerline_mapper")
OPTIONAL = NODES[2:]
EXAMPLES = """examples:
  python3 scripts/perceive.py V1_01_easy --out out/v101                 EuRoC's folder: calibration and truth are in it
  python3 scripts/perceive.py flight.mcap --sensors mine.yaml --truth mocap.tum --out out/flight
  python3 scripts/perceive.py bag_folder --sensors mine.yaml --truth /vicon/pose --out out/bag
  python3 scripts/perceive.py photos --out out/photos                   images: tags and wires in each
  python3 scripts/perceive.py V1_01_easy --out out/few -p vio.filter.clones:=8

writes report.html, report.json, vio.tum, estimator.tum, target.tum, truth.tum, powerlines.json; of images detections.json
exit code: 0 done, 1 VIO never gave a pose (or no image could be looked at), 2 the caller's mistake, 130 interrupted"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("perceive.py", __doc__, EXAMPLES)
    out.add_argument("recording", type=Path, metavar="RECORDING",
                     help="rosbag2 folder, .mcap, .db3, ROS 1 .bag, EuRoC or TUM-VI folder, images")
    out.add_argument("--sensors", metavar="FILE",
                     help="sensor file, or its name in config/sensors (default: the recording's own calibration)")
    out.add_argument("--truth", metavar="FILE",
                     help="true motion of the IMU's axes: TUM or EuRoC file, or a topic of the bag (default: the recording's own)")
    out.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    out.add_argument("--camera", metavar="NAME", help="camera of VIO (default: down, or the first)")
    out.add_argument("--front", metavar="NAME", help="camera of target localiser and powerline mapper (default: front, or that of VIO)")
    out.add_argument("--board", default="pad_four_tags", metavar="FILE",
                     help="tag board, or its name in config/boards (default: %(default)s)")
    out.add_argument("--without", choices=OPTIONAL, nargs="+", default=[], metavar="NODE", help=f"leave out: {', '.join(OPTIONAL)}")
    out.add_argument("-p", "--parameter", action="append", default=[], metavar="NODE.NAME:=VALUE", help="change a parameter of a node")
    return out


def _perceive(args: argparse.Namespace) -> int:
    one_thread_for_sums()
    overrides = parse_overrides(args.parameter)
    for node in overrides:
        if node not in NODES:
            raise PerchError(f"-p {node}: is not one of {', '.join(NODES)}")
    recording = open_recording(args.recording, load_sensors(args.sensors) if args.sensors else None)
    load_board(args.board)
    truth = read_truth(recording, args.truth)
    output_folder(args.out)
    for stale in ("report.html", "report.json"):  # of an earlier recording
        (args.out / stale).unlink(missing_ok=True)
    sensors = recording.sensors
    if recording.samples == 0 or sensors is None or sensors.imu is None:
        if recording.samples and sensors is None:
            raise PerchError(f"{args.recording}: has an IMU and no calibration: give --sensors FILE, made by `scripts/sensors.py import`")
        return _look_at_pictures(args, recording)
    if truth is not None:  # it is told of the IMU's axes, as EuRoC's is
        truth = truth.turned(so3.quat_from_matrix(sensors.imu.R_BI.T))
    return _run(args, recording, sensors, truth, overrides)


def _choose(sensors: Sensors, recording: Recording, given: str | None, preferred: str, option: str) -> str:
    """Return a camera: the given one, else the preferred one, else the first."""
    there = [name for name in sensors.cameras if recording.images.get(name)]
    if not there:
        raise PerchError(f"{recording.path}: there is no image")
    if given is not None and given not in there:
        raise ConfigError(option, given, f"is not one of {', '.join(there)}")
    return given or (preferred if preferred in there else there[0])


# -- recordings with an IMU ------------------------------------------------------------------------------------------


def _run(args: argparse.Namespace, recording: Recording, sensors: Sensors, truth: Trajectory | None,
         overrides: dict[str, dict[str, Any]]) -> int:
    down = _choose(sensors, recording, args.camera, "down", "--camera")
    front = _choose(sensors, recording, args.front, "front", "--front") if args.front or "front" in recording.images else down
    file = args.out / "sensors.yaml"  # what was used, beside what came of it
    file.write_text(to_yaml(sensors, f"of {recording.path.name}"))
    perception = Perception(sensors, str(file), down, front, args.board, overrides, args.without)
    for event in recording.read():
        perception.take(event)
    checked, vio = check(recording), _trajectory(perception.states)
    told = Told({"recording": str(recording.path), "camera": down, "front": front, "images": recording.images,
                 "imu_samples": recording.samples, "damage": recording.damage},
                [("recording", str(recording.path.resolve())),
                 ("sensors", f"{sensors.name}: VIO looks through {down}, the others through {front}")])
    _tell_motion(told, perception, vio, truth)
    _tell_surroundings(told, perception)
    told.figures |= {"findings": [vars(f) for f in checked.findings], "sensors": checked.figures}
    if recording.damage:
        told.rows.append(("damage", recording.damage))
    if perception.wires is not None:
        lines = perception.lines.lines if perception.lines is not None else ()
        write_json(args.out / "powerlines.json", [
            {"id": line.id, "start": list(line.start), "end": list(line.end), "radius": line.radius,
             "covariance": line.covariance.tolist(), "observations": line.observations} for line in lines])
    targets = Trajectory.of((target.stamp, target.p_WS, target.q_WS) for target in perception.targets)
    for name, motion in (("vio", vio), ("estimator", _trajectory(perception.odometry)), ("target", targets), ("truth", truth)):
        if motion is not None:
            write_tum(args.out / f"{name}.tum", motion)
    told.write(args.out, recording, checked.findings, perception.log)
    return 0 if perception.states else 1


def _tell_motion(told: Told, perception: Perception, vio: Trajectory, truth: Trajectory | None) -> None:
    """Add the results of VIO and estimator to the report."""
    frames, states = perception.vio.frames, perception.states
    outcomes = {name: sum(f.outcome == name for f in frames) for name in dict.fromkeys(f.outcome for f in frames)}
    cost = 1e3 * np.array([f.cost for f in frames]) if frames else np.zeros(1)
    median, p99 = float(np.median(cost)), float(np.percentile(cost, 99))
    restarts = frames[-1].restarts if frames else 0
    told.figures |= {"frames": outcomes, "restarts": restarts, "vio_frame_ms": {"median": median, "p99": p99}}
    told.rows += [("VIO frames", ", ".join(f"{n} {name.lower()}" for name, n in outcomes.items()) or "none"), ("restarts", str(restarts)),
                  ("VIO, CPU time of a frame", f"{median:.1f} ms in the median, {p99:.1f} ms p99")]
    compared = None
    if len(vio) > 1:
        moved = np.linalg.norm(vio.p - vio.p[0], axis=1)
        told.figures["vio"] = {"path_m": vio.length, "largest_distance_m": float(moved.max()), "final_distance_m": float(moved[-1])}
        told.rows.append(("VIO's path", f"{vio.length:.2f} m; ends {moved[-1]:.3f} m from its beginning, is at most {moved.max():.3f} m from it"))
        if truth is not None:
            try:
                compared = evaluate(vio, truth, np.array([s.covariance[:3, :3] for s in states]))
                told.figures["vio"] |= compared.figures
                told.rows += _evaluation_rows("VIO", compared)
                against = evaluate(_trajectory(perception.odometry[::max(1, len(perception.odometry) // 5000)]), truth)
                told.figures["estimator"] = against.figures
                told.rows += _evaluation_rows("estimator", against)[:2]
            except RecordingError as error:
                told.rows.append(("not compared", str(error)))
        told.plots["The path"] = path_figure(vio, compared)
        if compared is not None:
            index = {s.stamp: np.sqrt(np.diag(s.covariance)[:3]) for s in states}
            told.plots["Error and covariance"] = error_figure(compared, np.array([index[stamp] for stamp in compared.stamps.tolist()]))
        told.plots["Biases"] = bias_figure(perception)
    if frames:
        told.plots["Tracks over time"] = frames_figure(frames)
    told.pictures["Tracks"] = perception.vio.gallery.shown


def _tell_surroundings(told: Told, perception: Perception) -> None:
    """Add the results on board and wires to the report."""
    if perception.sightings:
        told.figures["target"], words = _board(perception)
        told.rows.append(("board", words))
    if perception.lines is not None:
        told.figures["powerlines"] = len(perception.lines.lines)
        words = f"{len(perception.lines.lines)} segments" + (f"; {perception.lines.message}" if perception.lines.message else "")
        told.rows.append(("powerlines", words))
    if perception.target is not None:
        told.pictures |= {"The board": perception.target.found.shown, "Without a board": perception.target.missed.shown[:3]}
    if perception.wires is not None:
        told.pictures["Wires"] = perception.wires.gallery.shown


def _board(perception: Perception) -> tuple[dict[str, float], str]:
    """Return the results on the board, which is static, as figures for JSON and in words."""
    seen = [s for s in perception.sightings if s.pose_camera is not None]
    figures = {"images": len(perception.sightings), "found": len(seen), "poses": len(perception.targets), "reprojection_rms_px": np.nan}
    words = f"found in {len(seen)} of {len(perception.sightings)} images"
    if seen:
        figures["reprojection_rms_px"] = rms = float(np.median([s.reprojection_rms for s in seen]))
        words += f", residual {rms:.2f} px"
    p = np.array([target.p_WS for target in perception.targets]).reshape(-1, 3)
    if len(p) > 1:
        figures["spread_m"] = spread = float(np.sqrt(((p - np.median(p, axis=0))**2).sum(axis=1).mean()))
        words += f"; its place in the map scatters by {100 * spread:.1f} cm rms"
    return figures, words


def _evaluation_rows(name: str, e: Evaluation) -> list[tuple[str, str]]:
    f = e.figures
    drift = f"{f['drift_percent']:.2f} % of the path" if np.isfinite(f["drift_percent"]) else "a path too short for a share"
    start = (f"{name}: from the start on", f"{100 * f['final_error_m']:.1f} cm off at the end ({drift}), "
             f"{100 * f['largest_error_m']:.1f} cm at most; attitude {f['attitude_rms_deg']:.2f} deg rms")
    nees = (f"{name}: NEES of the position", f"{f['nees_position_mean']:.2f} in the mean (honest: 3)")
    if not np.isfinite(f["ate_rmse_m"]):  # it stands, or moves along a line
        return [start, nees]
    attitude, why = (f", {f['ate_rmse_deg']:.2f} deg", "") if np.isfinite(f["ate_rmse_deg"]) else ("", "; too straight a path to align attitudes by")
    return [(f"{name}: ATE (evo)", f"{100 * f['ate_rmse_m']:.2f} cm{attitude} rms over {f['compared_s']:.1f} s and {f['path_m']:.1f} m{why}"), start,
            (f"{name}: RPE (evo)", f"{100 * f['rpe_rmse_m']:.2f} cm, {f['rpe_rmse_deg']:.2f} deg rms over {f['rpe_delta_m']:g} m"),
            (f"{name}: scale", f"{f['scale']:.4f}"), nees]


def _trajectory(states: Sequence[InertialState] | Sequence[OdometryState]) -> Trajectory:
    return Trajectory.of((state.stamp, state.p_WB, state.q_WB) for state in states)


# -- images alone ----------------------------------------------------------------------------------------------------


def _look_at_pictures(args: argparse.Namespace, recording: Recording) -> int:
    board, gallery, problems, seen = load_board(args.board), Gallery(24), [], {}
    for event in recording.read():
        image = event.value
        if not isinstance(image, CameraImage):
            continue
        name = getattr(image, "path", Path(str(image.stamp))).name
        sensor = recording.sensors.cameras.get(event.source) if recording.sensors else None
        mount = sensor.mount(event.source) if sensor else guessed_mount(event.source, image.width, image.height)
        wires = LineDetectionConfig(appearance="red" if sensor and sensor.colour else "plain")
        try:
            found = look(image, mount, board, wires, sensor is not None)
        except ImageError as error:
            problems.append(f"{name}: {error}")
            continue
        seen[name] = found.figures()
        gallery.offer(partial(drawn, image, found, board, name))
    problems += [recording.damage] if recording.damage else []
    tags, poses = sum(len(s["tags"]) for s in seen.values()), sum("board" in s for s in seen.values())
    rows = [("recording", str(recording.path.resolve())),
            ("images", f"{len(seen)}" + ("" if recording.sensors else "; the camera is not calibrated")), ("tags", str(tags)),
            ("board", f"posed in {poses}"), ("wires", str(sum(len(s["wires"]) for s in seen.values())))]
    rows += [("problem", problem) for problem in problems]
    write_json(args.out / "detections.json", seen)
    figures = {"images": len(seen), "tags": tags, "boards": poses, "problems": problems}
    Told(figures, rows, pictures={"What was found": gallery.shown}).write(args.out, recording)
    return 0 if seen else 1


main = command(parser, _perceive)
