"""Perception on public recordings, each scored against the reference of its repository; part of `python3 bench/recordings.py`.

Every function takes the folder of a recording and returns figures for JSON: lengths in m, angles in deg, errors of corners in px.
"""

from __future__ import annotations

import base64
import json
import re
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import yaml
from perch_core import so3
from perch_core.camera import Camera, camera_of
from perch_core.camera_mount import CameraMount
from perch_core.errors import PerchError
from perch_core.sensors import CalibrationSigmas
from perch_core.tag_board import Tag, TagBoard, TagGrid, load_board
from perch_eval.recordings import command
from perch_eval.recordings.image_detections import ImageDetections, detect, find_tags, guessed_mount
from perch_eval.recordings.recording import decoded, image_files, picture
from perch_perception.line_mapping import LineDetectionConfig
from perch_perception.tags import BoardLocalizer
from scipy.optimize import minimize

Tags = list[tuple[int, np.ndarray]]
"""Number and corners (TL, TR, BR, BL) [px], (4, 2), of each tag."""
Figures = dict[str, Any]
WIDTH = 1000  # to which photographs of the AprilGrid are scaled [px]
INCH = 0.0254  # side of the clipboard's tags; it is not documented, and errors are given as shares of the distance [m]
ROWS, COLUMNS = 6, 5  # of the clipboard's tags
TURNED = 180.0  # OpenCV's markers against AprilTag's own [deg]
PAD = load_board("pad_four_tags")
UNLISTED = {"33369213973_9d9bb4cc96_c": ((369, 356), (526, 329)), "34085369442_304b6bafd9_c": ((476, 332), (37, 347), (749, 114)),
            "34139872896_defdb2f8d9_c": ((524, 402), (481, 413), (389, 277), (752, 367), (600, 348), (302, 385), (313, 370), (362, 427))}
"""Centres [px] of tags of number 0 that NASA's reference lacks, seen by eye in each photograph where one was detected."""


# -- recordings with an IMU ------------------------------------------------------------------------------------------


EUROC_PERIOD = 5_000_000  # of its IMU [ns]


def run_perceive(recording: Path, *options: str) -> tuple[Figures, str]:
    """Run `scripts/perceive.py` on a recording; return its `report.json`, without times and text, and `report.html`."""
    with tempfile.TemporaryDirectory() as out:
        if command.main([str(recording), "--out", out, *options]):
            raise PerchError(f"{recording}: perceive.py failed")
        report, page = json.loads((Path(out) / "report.json").read_text()), (Path(out) / "report.html").read_text()
    kept = {key: report[key] for key in ("images", "frames", "restarts", "vio", "estimator", "target", "powerlines") if key in report}
    return kept | {"gyro_bias": report["sensors"]["gyro_bias"]}, page


def euroc(recording: Path, truth: Path) -> Figures:
    """Score a EuRoC folder against a truth file."""
    return run_perceive(recording, "--truth", str(truth))[0]


def euroc_of_parts(images: Path, imu: Path, truth: Path) -> Figures:
    """Score a part of an EuRoC sequence whose images, IMU and truth are in three places.

    Args:
        images: folder with `cam0`, of which `data` has the images.
        imu: folder with `data.csv`; its stamps may be rounded: they are put back on the grid of the images' stamps.
        truth: file of the true motion.
    """
    names = sorted(file.name for file in (images / "cam0" / "data").glob("*.png"))
    rows = [line.partition(",") for line in (imu / "data.csv").read_text().splitlines() if line[:1].isdigit() and ",," not in line]
    first = int(Path(names[0]).stem)
    with tempfile.TemporaryDirectory() as name:
        parts = _asl_folder(Path(name), images / "cam0" / "data", names, [
            f"{first + round((float(stamp) - first) / EUROC_PERIOD) * EUROC_PERIOD},{values}" for stamp, _, values in rows])
        for sensor, folder in (("cam0", images / "cam0"), ("imu0", imu)):
            (parts / sensor / "sensor.yaml").symlink_to((folder / "sensor.yaml").resolve())
        return euroc(Path(name), truth)


def _asl_folder(root: Path, images: Path, names: Sequence[str], samples: Sequence[str]) -> Path:
    """Make a recording in the ASL format of a folder of images, named by their stamps, and rows `stamp,w,f`; return its `mav0`."""
    parts = root / "mav0"
    for sensor, rows in (("cam0", [f"{Path(name).stem},{name}" for name in names]), ("imu0", samples)):
        (parts / sensor).mkdir(parents=True)
        (parts / sensor / "data.csv").write_text("".join(f"{row}\n" for row in rows))
    (parts / "cam0" / "data").symlink_to(images.resolve())
    return parts


def dm_vio(folder: Path) -> Figures:
    """Score a recording in DM-VIO's format: its own lens and mounting, the clock that `sensors.py check` finds, noise of a cheap IMU."""
    camera = np.loadtxt(folder / "cam0" / "camera.txt", max_rows=1)
    T_CI = np.array(yaml.safe_load((folder / "camchain.yaml").read_text().expandtabs())["cam0"]["T_cam_imu"])
    width, height = np.loadtxt(folder / "cam0" / "camera.txt", skiprows=1, max_rows=1, dtype=int).tolist()
    sensors = {"name": "l515", "cameras": {"cam0": {
        "model": "pinhole", "width": width, "height": height, "focal": camera[:2].tolist(), "centre": camera[2:4].tolist(),
        "position": (-T_CI[:3, :3].T @ T_CI[:3, 3]).tolist(), "orientation": so3.quat_from_matrix(so3.nearest(T_CI[:3, :3].T)).tolist(),
        "rate": 17.0, "stamp_offset": 0.04, "sigma": {"track": 1.0}}},
        "imu": {"rate": 200.0, "accel_noise_density": 1e-2, "gyro_noise_density": 1e-3, "accel_bias_walk": 1e-3, "gyro_bias_walk": 2e-5}}
    samples = [",".join(line.split()[:7]) for line in (folder / "imu.txt").read_text().splitlines() if line[:1].isdigit()]
    images = folder / "cam0" / "images"
    with tempfile.TemporaryDirectory() as name:
        _asl_folder(Path(name), images, sorted(file.name for file in images.iterdir()), samples)
        (Path(name) / "sensors.yaml").write_text(yaml.safe_dump(sensors))
        return run_perceive(Path(name), "--sensors", str(Path(name) / "sensors.yaml"), "--without", "target_localizer", "powerline_mapper")[0]


def photographed_floor(tests: Path, out: Path) -> Figures:
    """Score nine seconds of `photo_flight`; write its plots of path and error to `out`."""
    sys.path.insert(0, str(tests))
    import photo_flight  # type: ignore[import-not-found]

    with tempfile.TemporaryDirectory() as folder:
        found, page = run_perceive(photo_flight.write_asl(photo_flight.make(9.0), Path(folder) / "floor"))
    for title, name in (("The path", "floor_path"), ("Error and covariance", "floor_error")):
        png = page.partition(f"<h2>{title}</h2>")[2].partition("base64,")[2].partition('"')[0]
        (out / f"{name}.png").write_bytes(base64.b64decode(png))
    return found


# -- tags ------------------------------------------------------------------------------------------------------------


def grey(path: Path) -> np.ndarray:
    """Pixels of a photograph, uint8, shape (height, width)."""
    pixels = decoded(path, cv2.IMREAD_GRAYSCALE)
    if pixels is None:
        raise PerchError(f"{path}: is no image that can be read")
    return pixels


def detections_in(path: Path, mount: CameraMount | None = None, board: TagBoard = PAD) -> ImageDetections:
    """Return perceive.py's detections in a photograph; without a mount its camera counts as not calibrated."""
    image = picture(path, 0, "camera", None)
    mounted = mount or guessed_mount("camera", image.width, image.height)
    return detect(image, mounted, board, LineDetectionConfig(appearance="plain"), mount is not None)


@cache  # its second detector in a process crashes as it is destroyed
def pupil() -> Callable[..., list[Any]] | None:
    """The search of pupil-apriltags (`pip install pupil-apriltags`) in grey images at full resolution; None: it is not installed."""
    if not find_spec("pupil_apriltags"):
        return None
    from pupil_apriltags import Detector  # type: ignore[import-not-found,import-untyped]

    return Detector(families="tag36h11", quad_decimate=1.0).detect


def ours_of(corners: np.ndarray) -> np.ndarray:
    """Convert AprilTag's corners (lb, rb, rt, lt), (4, 2), with origin at the first pixel's corner, to our order and pixels."""
    return corners[[1, 0, 3, 2]] - 0.5


def detect_with_both(photographs: list[Path]) -> Iterator[tuple[str, list[Tags], int]]:
    """Yield detector, tags in each photograph, and total number of wire arcs, which pupil-apriltags does not detect."""
    views = [detections_in(path) for path in photographs]
    yield "ours", [list(view.tags) for view in views], sum(len(view.wires) for view in views)
    if (search := pupil()) is not None:
        found = [search(grey(path)) for path in photographs]
        yield "pupil", [[(tag.tag_id, ours_of(tag.corners)) for tag in tags] for tags in found], 0


def nasa(folder: Path) -> Figures:
    """Score photographs that have text files with AprilTag's unrefined tags, `number, (x y), (x y), (x y), (x y)` per line."""
    photographs, out = sorted(folder.glob("*.jpg")), Figures()
    reference = [[_line(row) for row in path.with_suffix(".txt").read_text().splitlines()] for path in photographs]
    for detector, found, arcs in detect_with_both(photographs):
        errors = [error for tags, true in zip(found, reference) for error in _errors(tags, true)]
        unseen = [tag for path, tags, true in zip(photographs, found, reference) for tag in tags
                  if not _is_seen(tag, true, UNLISTED.get(path.stem, ()))]
        out[detector] = {"photographs": len(photographs), "reference": sum(map(len, reference)), "found": len(errors),
                    "others": sum(map(len, found)) - len(errors), "false": len(unseen), "corner_px_median": float(np.median(errors)),
                    "corner_px_p90": float(np.percentile(errors, 90)), "arcs": arcs}
    return out


def _line(row: str) -> tuple[int, np.ndarray]:
    number, *corners = map(float, re.findall(r"[-\d.]+", row))
    return int(number), ours_of(np.reshape(corners, (4, 2)))


def _is_seen(tag: tuple[int, np.ndarray], reference: Tags, unlisted: Sequence[tuple[int, int]]) -> bool:
    """Whether a tag has number 0 and is within half its side of a reference tag or of an unlisted one's centre [px]."""
    number, corners = tag
    off = np.linalg.norm(np.array([*(c.mean(axis=0) for _, c in reference), *unlisted]) - corners.mean(axis=0), axis=1)
    return number == 0 and bool(off.min() < 0.5 * np.linalg.norm(corners[1] - corners[0]))


def _errors(found: Tags, reference: Tags) -> Iterator[np.ndarray]:
    """Errors of the corners [px], (4,), of each reference tag that has one of its number within half its side."""
    for number, corners in reference:
        near = min((c for n, c in found if n == number), key=lambda c: np.linalg.norm((c - corners).mean(axis=0)), default=None)
        if near is not None and np.linalg.norm((near - corners).mean(axis=0)) < 0.5 * np.linalg.norm(corners[1] - corners[0]):
            yield np.linalg.norm(near - corners, axis=1)


def rooms(folder: Path) -> Figures:
    """Score photographs, without wires, whose tags are listed in `groundtruth.txt`: a file and its numbers on each line."""
    lines = [line.split() for line in (folder / "groundtruth.txt").read_text().splitlines()]
    listed, out = [set(map(int, numbers)) for _, *numbers in lines], Figures()
    for detector, found, arcs in detect_with_both([folder / name for name, *_ in lines]):
        right = sum(len(true & {number for number, _ in tags}) for tags, true in zip(found, listed))
        out[detector] = {"photographs": len(lines), "reference": sum(map(len, listed)), "found": right,
                    "false": sum(map(len, found)) - right, "arcs": arcs}
    return out


def rotation(folder: Path) -> Figures:
    """Score one tag on a turntable: rotation of each pose from that at 0 deg, against the angle in the file name."""
    about = yaml.safe_load((folder / "test_info.yaml").read_text())["rotation_test"]
    K, side = np.reshape(about["K"], (3, 3)), about["tag_size"]
    mount = CameraMount("camera", camera_of("", about["width"], about["height"], K, np.zeros(0)), np.zeros(3), np.eye(3))
    board = TagBoard((2 * side, 2 * side), (Tag(76, (0.0, 0.0), side),))
    photographs = {int(re.findall(r"-?\d+", name)[-1]): folder / name for name in about["files"]}
    views = {angle: detections_in(path, mount, board) for angle, path in photographs.items()}
    out = {"ours": _turns({angle: view.board.R_CS for angle, view in views.items() if view.board is not None})
           | {"photographs": len(views), "arcs": sum(len(view.wires) for view in views.values())}}
    if (search := pupil()) is not None:
        lens = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])
        found = {angle: search(grey(path), True, lens, side) for angle, path in photographs.items()}
        out["pupil"] = _turns({angle: tags[0].pose_R for angle, tags in found.items() if tags})
    return out


def _turns(attitudes: dict[int, np.ndarray]) -> Figures:
    """Return the errors of the rotation since 0 deg, for attitudes (3, 3) by angle [deg]."""
    off = [abs(np.degrees(np.linalg.norm(so3.log(R @ attitudes[0].T))) - abs(angle)) for angle, R in attitudes.items() if angle]
    return {"poses": len(attitudes), "error_deg_mean": float(np.mean(off)), "error_deg_max": float(np.max(off))}


@dataclass(frozen=True)
class Calibration:
    """OpenCV's calibration from views of a board: residual [px], lens, and poses (p_CS, R_CS) of the board in each view."""

    rms: float
    camera: Camera
    poses: list[tuple[np.ndarray, np.ndarray]]


def calibrated(views: list[Tags], board: TagBoard, size: tuple[int, int]) -> Calibration:
    """Calibrate the lens (radial-tangential, four coefficients) from views of a board's tags; `size`: width, height [px]."""
    points = [np.concatenate([board.corners_S[board.ids.index(n)] for n, _ in view]).astype(np.float32) for view in views]
    pixels = [np.concatenate([corners for _, corners in view]).astype(np.float32) for view in views]
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_K3
    rms, K, lens, turns, places = cv2.calibrateCamera(points, pixels, size, guessed_mount("camera", *size).camera.K, None, flags=flags)
    poses = [(place.ravel(), cv2.Rodrigues(turn)[0]) for turn, place in zip(turns, places)]
    return Calibration(rms, camera_of("plumb_bob", *size, K.astype(float), lens.astype(float).ravel()[:5]), poses)


def aprilgrid(folder: Path) -> Figures:
    """Score photographs of Kalibr's grid: number of tags in each, and residual of one lens model for all."""
    board = TagBoard((0.75, 0.75), border=2, corner_squares=True, grid=TagGrid(6, 6, 0.088, 0.3, rotation=TURNED))
    images = [grey(path) for path in image_files(folder)]
    images = [cv2.resize(g, (WIDTH, round(WIDTH / g.shape[1] * g.shape[0])), interpolation=cv2.INTER_AREA) for g in images]
    size = images[0].shape[::-1]
    views = [find_tags(image, guessed_mount("camera", *size).camera, board) for image in images]
    known = [[tag for tag in view if tag[0] in board.ids] for view in views]
    return {"tags": [len(view) for view in known], "false": sum(map(len, views)) - sum(map(len, known)),
            "residual_px": calibrated(known, board, size).rms}


def clipboard_board(steps: np.ndarray, numbers: list[int]) -> TagBoard:
    """Return a board of some of the sheet's tags; `steps`: spacing of rows and of columns, in sides of a tag, shape (2,)."""
    centres = {n: INCH * np.array(steps) * (ROWS // 2 - n // COLUMNS, COLUMNS // 2 - n % COLUMNS) for n in numbers}
    return TagBoard((0.5, 0.5), tuple(Tag(n, tuple(centre.tolist()), INCH, TURNED) for n, centre in centres.items()))


def clipboard(folder: Path) -> Figures:
    """Score poses of eight boards of six random tags (fixed seed) per image, against a calibration from all tags and images."""
    images = [grey(path) for path in image_files(folder)]
    size, everything, rng = images[0].shape[::-1], list(range(ROWS * COLUMNS)), np.random.default_rng(0)
    views = [find_tags(image, guessed_mount("camera", *size).camera, PAD) for image in images]
    steps = minimize(lambda x: calibrated(views, clipboard_board(x, everything), size).rms, (1.57, 1.57), method="Nelder-Mead",
                     options={"xatol": 1e-4, "fatol": 1e-4}).x
    reference = calibrated(views, clipboard_board(steps, everything), size)
    mount, tried, places, turns, nees = CameraMount("camera", reference.camera, np.zeros(3), np.eye(3)), 0, [], [], []
    for image, view, (p_CS, R_CS) in zip(images, views, reference.poses):
        for _ in range(8):
            board = clipboard_board(steps, rng.choice([number for number, _ in view], 6, replace=False).tolist())
            pose, tried = BoardLocalizer(board, mount).process(image, 0.0).board, tried + 1
            if pose is not None:
                error = np.concatenate([pose.p_CS - p_CS, so3.log(pose.R_CS @ R_CS.T)])
                by_lens = pose.by_intrinsics * CalibrationSigmas().lens
                places.append(float(np.linalg.norm(error[:3]) / np.linalg.norm(p_CS)))
                turns.append(float(np.degrees(np.linalg.norm(error[3:]))))
                nees.append(error @ np.linalg.solve(pose.covariance + by_lens @ by_lens.T, error) / 6)
    return {"boards": tried, "poses": len(places), "position_percent_rms": 100 * _rms(places), "attitude_deg_rms": _rms(turns),
            "nees_mean": float(np.mean(nees)), "nees_median": float(np.median(nees)), "reference_px": reference.rms}


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
