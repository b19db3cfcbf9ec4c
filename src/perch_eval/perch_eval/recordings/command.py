"""Perception on a recording: VIO, estimator, target localiser and powerline mapper, with a report."""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Container, Sequence
from functools import partial
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import config, so3
from perch_core.errors import ConfigError, PerchError
from perch_core.json_values import write_json
from perch_core.processes import single_threaded_blas
from perch_core.sensors import Sensors, load_sensors
from perch_core.tag_board import load_board
from perch_core.values import CameraImage, InertialState, OdometryState
from perch_eval.arguments import command, command_parser, output_folder
from perch_eval.node_launch import parse_overrides
from perch_eval.recordings.calibration import to_yaml
from perch_eval.recordings.check import check
from perch_eval.recordings.image_detections import Gallery, detect, draw_detections, guessed_mount
from perch_eval.recordings.imu_check import check_estimated_biases
from perch_eval.recordings.opening import open_recording
from perch_eval.recordings.perception import Perception, node_config
from perch_eval.recordings.recording import Recording, RecordingError
from perch_eval.recordings.report import ReportContent, bias_figure, error_figure, frames_figure, path_figure
from perch_eval.recordings.trajectory import Trajectory, evaluate, read_truth, write_tum
from perch_perception.images import ImageError
from perch_perception.powerline_mapper import PowerlineMapperConfig
from perch_perception.target_localizer import TargetLocalizerConfig

NODES = ("vio", "estimator", "target_localizer", "powerline_mapper")
OPTIONAL = NODES[2:]
IN_IMAGES = ("target_localizer.board", "target_localizer.max_range",
             "powerline_mapper.detection.appearance", "powerline_mapper.detection.redness")
"""Parameters that apply to images without an IMU."""
EXAMPLES = """examples:
  python3 scripts/perceive.py V1_01_easy --out out/v101                 EuRoC's folder: calibration and truth are in it
  python3 scripts/perceive.py flight.mcap --sensors mine.yaml --truth mocap.tum --out out/flight
  python3 scripts/perceive.py bag_folder --sensors mine.yaml --truth /vicon/pose --out out/bag
  python3 scripts/perceive.py photos --out out/photos                   images: tags and wires in each
  python3 scripts/perceive.py V1_01_easy --out out/few -p vio.filter.clones:=8

writes report.html, report.json, vio.tum, estimator.tum, target.tum, truth.tum, powerlines.json; of images detections.json
exit code: 0 done, 1 VIO never estimated a pose (or no image could be read), 2 invalid input, 130 interrupted"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("perceive.py", __doc__, EXAMPLES)
    out.add_argument("recording", type=Path, metavar="RECORDING",
                     help="rosbag2 folder, .mcap, .db3, ROS 1 .bag, EuRoC or TUM-VI folder, images")
    out.add_argument("--sensors", metavar="FILE",
                     help="sensor file, or its name in config/sensors (default: the recording's own calibration)")
    out.add_argument("--truth", metavar="FILE",
                     help="true motion of the IMU's axes: TUM or EuRoC file, or a topic of the bag (default: the recording's own; of a "
                          "recording of perch, ground_truth/odometry)")
    out.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the results")
    out.add_argument("--camera", metavar="NAME", help="camera of VIO (default: down, or the first)")
    out.add_argument("--front", metavar="NAME", help="camera of target localiser and powerline mapper (default: front, or that of VIO)")
    out.add_argument("--board", default="pad_four_tags", metavar="FILE",
                     help="tag board, or its name in config/boards (default: %(default)s)")
    out.add_argument("--without", choices=OPTIONAL, nargs="+", default=[], metavar="NODE", help=f"leave out: {', '.join(OPTIONAL)}")
    out.add_argument("-p", "--parameter", action="append", default=[], metavar="NODE.NAME:=VALUE", help="change a parameter of a node")
    return out


def _perceive(args: argparse.Namespace) -> int:
    single_threaded_blas()
    overrides = parse_overrides(args.parameter)
    for node in overrides:
        if node not in NODES:
            raise PerchError(f"-p {node}: is not one of {', '.join(NODES)}")
    recording = open_recording(args.recording, load_sensors(args.sensors) if args.sensors else None, args.front or args.camera)
    load_board(args.board)
    truth = read_truth(recording, args.truth)
    output_folder(args.out)
    for stale in ("report.html", "report.json"):  # of an earlier recording
        (args.out / stale).unlink(missing_ok=True)
    sensors = recording.sensors
    if recording.samples == 0 or sensors is None or sensors.imu is None:
        if recording.samples and sensors is None:
            raise PerchError(f"{args.recording}: has an IMU and no calibration: give --sensors FILE, made by `scripts/sensors.py import`")
        return _detect_in_images(args, recording, overrides)
    if truth is not None:  # it is that of the IMU's axes, as EuRoC's is
        truth = truth.turned(so3.quat_from_matrix(sensors.imu.R_BI.T))
    return _run(args, recording, sensors, truth, overrides)


def _choose(sensors: Sensors, recording: Recording, given: str | None, preferred: str, option: str) -> str:
    """Return a camera: the given one, else the preferred one, else the first."""
    available = [name for name in sensors.cameras if recording.images.get(name)]
    if not available:
        raise PerchError(f"{recording.path}: there is no image")
    if given is not None and given not in available:
        raise ConfigError(option, given, f"is not one of {', '.join(available)}")
    return given or (preferred if preferred in available else available[0])


# -- recordings with an IMU ------------------------------------------------------------------------------------------


def _run(args: argparse.Namespace, recording: Recording, sensors: Sensors, truth: Trajectory | None,
         overrides: dict[str, dict[str, Any]]) -> int:
    down = _choose(sensors, recording, args.camera, "down", "--camera")
    front = _choose(sensors, recording, args.front, "front", "--front") if args.front or "front" in recording.images else down
    file = args.out / "sensors.yaml"  # what was used, beside what came of it
    file.write_text(to_yaml(sensors, f"of {recording.path.name}"))
    perception = Perception(sensors, str(file), down, front, args.board, overrides, args.without)
    for event in recording.read():
        perception.process(event)
    checked, vio = check(recording), _trajectory(perception.states)
    if sensors.imu is not None:
        check_estimated_biases(checked, perception.states, sensors.imu)
    content = ReportContent({"recording": str(recording.path.resolve()), "calibration": sensors.name, "camera": down, "front": front,
                             "images": recording.images, "imu_samples": recording.samples, "damage": recording.damage})
    _add_motion(content, perception, vio, truth)
    _add_surroundings(content, perception)
    if perception.wires is not None:
        lines = perception.lines.lines if perception.lines is not None else ()
        write_json(args.out / "powerlines.json", [
            {"id": line.id, "start": list(line.start), "end": list(line.end), "radius": line.radius,
             "covariance": line.covariance.tolist(), "observations": line.observations} for line in lines])
    targets = Trajectory.from_poses((target.stamp, target.p_WS, target.q_WS) for target in perception.targets)
    for name, motion in (("vio", vio), ("estimator", _trajectory(perception.odometry)), ("target", targets), ("truth", truth)):
        if motion is not None:
            write_tum(args.out / f"{name}.tum", motion)
    content.write(args.out, recording, checked, perception.log)
    return 0 if perception.states else 1


def _add_motion(content: ReportContent, perception: Perception, vio: Trajectory, truth: Trajectory | None) -> None:
    """Add the results of VIO and estimator to the report."""
    frames, states = perception.vio.frames, perception.states
    outcomes = Counter(result.outcome.name for _, _, result in frames)
    cost = 1e3 * np.array([cost for _, cost, _ in frames]) if frames else np.zeros(1)
    median, p99 = float(np.median(cost)), float(np.percentile(cost, 99))
    restarts = frames[-1][2].restarts if frames else 0
    content.figures |= {"frames": outcomes, "restarts": restarts, "vio_frame_ms": {"median": median, "p99": p99}}
    compared = None
    if len(vio) > 1:
        moved = np.linalg.norm(vio.p - vio.p[0], axis=1)
        content.figures["vio"] = {"path_m": vio.length, "largest_distance_m": float(moved.max()), "final_distance_m": float(moved[-1])}
        if truth is not None:
            try:
                compared = evaluate(vio, truth, np.array([s.covariance[:3, :3] for s in states]))
                content.figures["vio"] |= compared.figures
                content.figures["estimator"] = evaluate(_trajectory(perception.odometry[::max(1, len(perception.odometry) // 5000)]), truth).figures
            except RecordingError as error:
                content.figures["not_compared"] = str(error)
        content.plots["The path"] = path_figure(vio, compared)
        if compared is not None:
            index = {s.stamp: np.sqrt(np.diag(s.covariance)[:3]) for s in states}
            content.plots["Error and covariance"] = error_figure(compared, np.array([index[stamp] for stamp in compared.stamps.tolist()]))
        content.plots["Biases"] = bias_figure(states)
    if frames:
        content.plots["Tracks over time"] = frames_figure(frames)
    content.pictures["Tracks"] = perception.vio.gallery.images


def _add_surroundings(content: ReportContent, perception: Perception) -> None:
    """Add the results on board and wires to the report."""
    if perception.sightings:
        content.figures["target"] = _board(perception)
    if perception.lines is not None:
        content.figures |= {"powerlines": len(perception.lines.lines), "powerlines_message": perception.lines.message}
    if perception.target is not None:
        content.pictures |= {"The board": perception.target.found.images, "Without a board": perception.target.missed.images[:3]}
    if perception.wires is not None:
        content.pictures["Wires"] = perception.wires.gallery.images


def _board(perception: Perception) -> dict[str, float]:
    """Return the results on the board, which is static."""
    found = [s for s in perception.sightings if s.pose_camera is not None]
    p = np.array([target.p_WS for target in perception.targets]).reshape(-1, 3)
    return {"images": len(perception.sightings), "found": len(found), "poses": len(p),
            "reprojection_rms_px": float(np.median([s.reprojection_rms for s in found])) if found else np.nan,
            "spread_m": float(np.sqrt(((p - np.median(p, axis=0))**2).sum(axis=1).mean())) if len(p) > 1 else np.nan}


def _trajectory(states: Sequence[InertialState] | Sequence[OdometryState]) -> Trajectory:
    return Trajectory.from_poses((state.stamp, state.p_WB, state.q_WB) for state in states)


# -- images alone ----------------------------------------------------------------------------------------------------


def _detect_in_images(args: argparse.Namespace, recording: Recording, overrides: dict[str, dict[str, Any]]) -> int:
    for name in config.flattened(overrides):
        if name not in IN_IMAGES:
            raise PerchError(f"-p {name}: does not apply to images without an IMU; these do: {', '.join(IN_IMAGES)}")
    target = node_config("target_localizer", TargetLocalizerConfig, {"board": args.board}, overrides)
    board, gallery, problems = load_board(target.board), Gallery(24), []
    detections: dict[str, dict[str, Any]] = {}
    cameras = recording.sensors.cameras if recording.sensors else {}
    appearances = {camera: "red" if camera in cameras and cameras[camera].colour else "plain" for camera in recording.images}
    wires = {camera: node_config("powerline_mapper", PowerlineMapperConfig, {"detection.appearance": appearance}, overrides).detection
             for camera, appearance in appearances.items()}
    chosen = args.front or args.camera
    if chosen and chosen not in recording.images:
        raise ConfigError("--front" if args.front else "--camera", chosen, f"is not one of {', '.join(recording.images)}")
    for event in recording.read():
        image = event.value
        if not isinstance(image, CameraImage) or (chosen and event.source != chosen):
            continue
        name = _unused(detections, getattr(image, "path", Path(str(image.stamp))).name, event.source)
        sensor = cameras.get(event.source)
        mount = sensor.mount(event.source) if sensor else guessed_mount(event.source, image.width, image.height)
        try:
            found = detect(image, mount, board, wires[event.source], sensor is not None, target.max_range)
        except ImageError as error:
            problems.append(f"{name}: {error}")
            continue
        detections[name] = found.figures()
        gallery.offer(image.stamp, partial(draw_detections, image, found, board, name))
    problems += [recording.damage] if recording.damage else []
    sensors = recording.sensors
    missing = "calibration of the camera" if sensors is None else "IMU in the sensor file" if sensors.imu is None else ""
    figures = {"recording": str(recording.path.resolve()), "images": len(detections), "missing": missing,
               "tags": sum(len(d["tags"]) for d in detections.values()), "boards": sum("board" in d for d in detections.values()),
               "wires": sum(len(d["wires"]) for d in detections.values()), "problems": problems}
    write_json(args.out / "detections.json", detections)
    ReportContent(figures, pictures={"What was found": gallery.images}).write(args.out, recording)
    return 0 if detections else 1


def _unused(taken: Container[str], name: str, camera: str) -> str:
    """Return an image's name, made unique: images of several cameras share names or stamps, and a driver may not stamp at all."""
    if name not in taken:
        return name
    numbered = (f"{camera}/{name} ({k})" for k in count(2))
    return next(other for other in chain([f"{camera}/{name}"], numbered) if other not in taken)


main = command(parser, _perceive)
