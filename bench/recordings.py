#!/usr/bin/env python3
"""Score perception on public recordings and photographs, and write docs/results/recordings.

Takes ten minutes on two cores. What is missing is marked "not available".
"""

from __future__ import annotations

import argparse
import json
import math
import signal
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

if __name__ == "__main__":
    sys.path[:0] = [str(Path(__file__).resolve().parents[1] / folder) for folder in ("scripts", "tests")]
    from perch_setup import enter, leave_quietly_on_interrupt

    enter("recordings")
    leave_quietly_on_interrupt()  # until scoring begins

import real_motion
import recordings_scores as scores
import recordings_wires
from perch_core.errors import ConfigError
from perch_core.json_values import finite, write_json
from perch_core.processes import single_threaded_blas
from perch_eval.arguments import command, command_parser, output_folder
from perch_eval.evaluation.document import machine, table
from perch_eval.revision import banner, code_version, root
from recordings_scores import Figures

EXAMPLES = """examples:
  git clone https://github.com/OWNER/NAME FOLDER/OWNER/NAME        each repository that is named where one is missing
  nice -n 15 python3 bench/recordings.py FOLDER
  nice -n 15 python3 bench/recordings.py FOLDER --only floor

exit code: 0 written, 2 wrong arguments or a recording that cannot be scored, 130 interrupted"""


@dataclass(frozen=True)
class Recording:
    """A recording: title, description, source, licence and scoring.

    Attributes:
        paths: repository and path in it, `owner/name/path`; the scored data, and a truth from another repository.
        score: called with the paths or, if there are none, with tests/recordings and the folder of the page.
    """

    title: str
    about: str
    paths: tuple[str, ...]
    licence: str
    score: Callable[..., Figures]


SWATBOTICS = "swatbotics/apriltag/images"
RECORDINGS = {
    "v101": Recording("V1_01, start", "4.7 s of EuRoC V1_01_easy: the drone stands, its rotors idle; radtan camera 20 Hz, ADIS16448 200 Hz",
                      ("MIT-SPARK/Kimera-VIO/tests/data/MicroEurocDataset", "rpng/open_vins/ov_data/euroc_mav/V1_01_easy.csv"),
                      "of ASL, ETH Zurich; the second is the truth", scores.euroc),
    "v101_flight": Recording("V1_01, in flight", "4.5 s of EuRoC V1_01_easy from 12 s on, a climb with a turn; VIO starts in motion",
                             ("Boscuit/UAV_BackTrack/data", "MIT-SPARK/Kimera-VIO/tests/data/MicroEurocDataset/mav0/imu0",
                              "rpng/open_vins/ov_data/euroc_mav/V1_01_easy.txt"), "of ASL, ETH Zurich", scores.euroc_of_parts),
    "mh01": Recording("MH_01, by hand", "30 s of EuRoC MH_01_easy before its take-off: moved by hand for 16 s, then at rest; VIO starts in motion",
                      ("ShuohuangYang/Visual-Inertial-Odometry-for-a-Quadrotor/proj2_2/dataset/MachineHall01_reduced",
                       "kalebburnham/IMU-Research/mav0/imu0", "rpng/open_vins/ov_data/euroc_mav/MH_01_easy.txt"), "of ASL, ETH Zurich",
                      scores.euroc_of_parts),
    "l515": Recording("L515, by hand", "124 s through a dim room, rolling shutter 17 Hz, stamps with 10 ms of jitter and gaps up to 431 ms; no truth",
                      ("Zoltan3057/DM-VIO-dataset",), "none named", scores.dm_vio),
    "floor": Recording("photographed floor",
                       "9 s by hand over gravel and four tags; noise of an MPU-9250's data sheet, gyro bias 0.028 rad/s", (),
                       "[tests/recordings](../../../tests/recordings/README.md), CC0 1.0", scores.photographed_floor),
    "racing": Recording("racing motion, rendered", "the first 13 or 15 s (36 to 41 m) of three flights of UZH-FPV, whose images are not here: ours along "
                        "their truth, five seeds each", ("rpng/open_vins/ov_data/uzhfpv_indoor",), "of RPG, University of Zurich",
                        real_motion.evaluate_flights),
    "nasa": Recording("NASA", "three photographs with 47 reference tags 36h11, all of number 0", ("AprilRobotics/apriltag/test/data",),
                      "CC BY-SA 2.0", scores.nasa),
    "rotation": Recording("rotation series", "15 photographs of one tag, turned by -70 to 70 deg", ("pupil-labs/apriltags/test",),
                          "BSD-2", scores.rotation),
    "rooms": Recording("rooms", "72 photographs of rooms, 236 tags whose numbers are listed", (f"{SWATBOTICS}/mapping_feb_2014",),
                       "Michigan's, all rights reserved", scores.rooms),
    "clipboard": Recording("clipboard", "10 images of 30 tags on a sheet of paper, 320 x 240", (f"{SWATBOTICS}/clipboard",),
                           "Michigan's, all rights reserved", scores.clipboard),
    "aprilgrid": Recording("AprilGrid", "five photographs of Kalibr's 6 x 6 grid on a monitor, two modules of border, scaled to 1000 px",
                           ("powei-lin/aprilgrid/example/data",), "BSD-3", scores.aprilgrid),
    "street": Recording("street wires", "12 photographs of wires before sky, houses and trees",
                        ("smilopintus/power-line-detection/test images",), "none named", recordings_wires.street),
    "pldu": Recording("PLDU", "photographs from drones over towns, with every wire traced", ("SnorkerHeng/PLD-UAV/PLDU",), "none named",
                      recordings_wires.traced),
    "pldm": Recording("PLDM", "the same, in mountains", ("SnorkerHeng/PLD-UAV/PLDM",), "none named", recordings_wires.traced),
}
MISSING = "not available"
RACING_ERROR_MAX = 0.2  # required of every seed: error at the end of racing motion, share of the path [%]
NEES_MAX = 1.0  # required of every recording with a truth, per dimension: its expectation
REQUIRED: dict[str, tuple[str, dict[str, float]]] = {  # of VIO's other figures, each at most: in words, and by key
    "v101": ("1 cm at the end", {"final_error_m": 0.01}),
    "v101_flight": ("3 % at the end", {"drift_percent": 3.0}),
    "mh01": ("5 cm at the end, 1.5 deg", {"final_error_m": 0.05, "attitude_rms_deg": 1.5}),
    "floor": ("5 cm at the end, 1.5 deg", {"final_error_m": 0.05, "attitude_rms_deg": 1.5}),
}
INTRODUCTION = """
What `scripts/perceive.py` makes of public recordings and photographs of real sensors, against their repositories' own references.
Nothing is random but which six tags of the clipboard make a board (fixed seed). The recordings are not part of this repository;
`tests/recordings` makes one of a photograph. EuRoC's and TUM-VI's whole archives are on servers of their own.
"""
ODOMETRY = """
## Visual-inertial odometry

ATE by `evo`, after alignment; drift and attitude from the start on, with place and heading of the start taken away.
"""
FLIGHT = """
V1_01 in flight: 4 s with little acceleration hardly determine the scale. The IMU alone, fitted to the true path with free velocity, tilt
and bias, makes this path 9 % longer than it is (5 mm rms of misfit)."""
MH01 = """
MH_01: its truth jumps by 5 mm within 5 ms, 0.2 s after VIO's first pose; it makes half of the NEES. From nine later starts (8bef865), each
over 5.4 s, it is 3.4 to 14 (mean 8.4), with 0.2 to 1.4 cm at the end: after a start in motion the covariance is too small, for the velocity
from the first pose on (5.2), for the accelerometer's bias later (0.7 at the first pose, 2.5 after 4 s). The cause is not known; it is
neither the clocks (truth against IMU: 0.0 ms) nor the heading that is taken away (0.07 deg)."""
V101 = """
At rest a tilt cannot be distinguished from the accelerometer's bias."""
RACING = """
**Racing motion, rendered.** UZH-FPV's truth, our camera with errors of calibration as in all our flights, our IMU. Until the take-off the
drone stands still, where the truth jitters by millimetres; the floor is 1 m below that place. The IMU's noise decides: with that of its
data sheet alone, without the vibration of rotors (accelerometer 0.003 instead of 0.015 m/s^2/sqrt(Hz), gyro 1.7e-4 instead of 5e-4, as
drawn and as declared), the errors are 0.06 to 0.43 %, median 0.17 %, and 11 of 15 hold (974f4b0a).
"""
TAGS = """
The whole sequences are not to be had here. For comparison, OpenVINS with one camera has an ATE of 7.6 cm and 0.64 deg on the whole of
V1_01 (58 m), and errors of 9.4 cm and 0.83 deg over each 8 m (1.2 %), after alignment (its `docs/eval-error.dox`); on MH_01 (80 m) an ATE
of 25 cm and 0.96 deg (`symao/open_vins/ov_msckf_result.md`).

![Path over the photographed floor](floor_path.png)

*Path over the photographed floor: truth and VIO, from above and from the side*

![Error over the photographed floor](floor_error.png)

*Error over the photographed floor: position with 3 sigma of VIO, and attitude*

## Tags

Beside pupil-apriltags (`.venv/bin/python -m pip install --no-deps pupil-apriltags`) with `quad_decimate` 1 on the same images:
"""
WIRES = """
NASA's reference lacks tags: a detection beyond it is false unless it is on a tag of number 0 that was seen by eye (their places are
`UNLISTED` in `bench/recordings_scores.py`). The clipboard's reference is the calibration over all its images and tags, and over the
distances between its rows and columns: the paper is not flat. The rotation series is scored with its repository's calibration.

## Wires

By length, within 8 px of the traced edges of a wire. PLDU and PLDM: all photographs of the published test sets, every
sixth of which was used to choose thresholds. The street's wires are not traced: the arcs in these pictures were judged by eye, and a point
was marked on each that is on a wire (`WIRES_SEEN`). The others follow window frames, joints in a wall, edges of roofs
and walls, and poles.
"""
END = """
In rooms arcs are edges of doors and folds of curtains, on NASA's photographs painted lines. What lies on a surface is distinguished from a
wire by its motion (`backdrop`), which single photographs do not show. Wires that end at a pole before they cross half of the image are not
found."""

L515 = ("L515, with `sigma: {{track: 1.0}}` in the sensor file: {tracked} of {all} frames tracked, {restarts} restarts, "
        "{vio[path_m]:.0f} m, the end {vio[final_distance_m]:.2f} m from the start.")
TURNS = ("{poses} poses; the turn against the photograph at 0 deg is wrong by {error_deg_mean:.2f} deg in the mean, "
         "{error_deg_max:.1f} deg at most")
ROOMS = "{found} of {reference} found, {false} false"
POSES = ("position {position_percent_rms:.2f} % rms of the distance, attitude {attitude_deg_rms:.2f} deg rms, NEES per dimension "
         "{nees_mean:.1f} (median {nees_median:.1f}), {poses} of {boards}; residual of the reference {reference_px:.2f} px")
WIRES_TRACED = ("precision {precision:.0f} %, recall {recall:.0f} % (without any sixth of the photographs they change by at most "
                "{precision_without_a_sixth:.1f} and {recall_without_a_sixth:.1f} percentage points)")
ARCS = "{ours[arcs]} arcs in {ours[photographs]} photographs"
IN_MAP = "{powerlines} wires in the map"
"""Results in words, of the figures of a recording."""


# -- the page --------------------------------------------------------------------------------------------------------


def required(key: str, vio: Figures) -> str:
    """Return whether VIO's figures on a recording are within what is required, with the bars."""
    text, others = REQUIRED[key]
    bars = others | {"nees_position_mean": 3 * NEES_MAX}
    return f"{'holds' if all(vio[name] is not None and vio[name] <= bar for name, bar in bars.items()) else 'fails'} ({text}, NEES {NEES_MAX:g})"


def motion(key: str, f: Figures) -> list[str]:
    """Cells of a row on odometry."""
    vio = f["vio"]
    ate = "-" if vio["ate_rmse_m"] is None else f"{100 * vio['ate_rmse_m']:.2f} cm" + (
        "" if vio["ate_rmse_deg"] is None else f", {vio['ate_rmse_deg']:.2f} deg")
    drift = "" if vio["drift_percent"] is None else f", {vio['drift_percent']:.2f} %"
    return [f"{vio['compared_s']:.1f} s, {vio['path_m']:.1f} m", ate, f"{100 * vio['final_error_m']:.1f} cm{drift}",
            f"{vio['attitude_rms_deg']:.2f} deg", f"{vio['nees_position_mean'] / 3:.1f}", str(f["restarts"]), required(key, vio)]


def race(f: Figures) -> list[str]:
    """Cells of a row on racing motion."""
    errors = f["error_percent"]
    within = sum(error <= RACING_ERROR_MAX for error in errors)
    return [f["flight"], f"{f['path_m']:.1f} m", ", ".join(f"{error:.2f}" for error in errors) + " %",
            f"{'holds' if within == len(errors) and f['nees'] <= NEES_MAX else 'fails'} ({within} of {len(errors)})", f"{f['nees']:.1f}", str(f["lost"])]


def corners(f: Figures) -> str:
    """Return the result on NASA's tags as text."""
    others = f"; {f['others']} more than the reference has, {f['false']} false" if f["others"] else ""
    return (f"{f['found']} of {f['reference']} found, corners {f['corner_px_median']:.2f} px median "
            f"({f['corner_px_p90']:.2f} px at 90 %){others}")


def grid(f: Figures) -> str:
    """Return the result on the AprilGrid as text."""
    return (f"{', '.join(map(str, f['tags']))} of 36 tags (one photograph cuts the grid), {f['false']} false; on one lens to "
            f"{f['residual_px']:.2f} px")


def board(f: Figures) -> str:
    """Return the result on the floor's four tags as text."""
    f = f["target"]
    return (f"{f['found']} of {f['images']} images, residual {f['reprojection_rms_px']:.2f} px; the board's place in the map scatters by "
            f"{100 * f['spread_m']:.1f} cm rms")


def judged(f: Figures) -> str:
    """Return the result on the street's wires as text."""
    return f"{f['arcs']} arcs in {f['photographs']} photographs, {f['arcs'] - f['wires']} of them not on wires, by eye"


def page(results: Mapping[str, Figures], command: str, code: Mapping[str, str]) -> list[str]:
    """Lines of README.md; `results`: figures by key of the recording; `code`: commit and digest of their code."""
    def row(key: str, text: Callable[[Figures], str], what: str = "") -> list[str]:
        return [RECORDINGS[key].title + what, text(results[key]) if key in results else MISSING]

    def pair(key: str, text: Callable[[Figures], str]) -> list[str]:
        ours, theirs = (results.get(key, {}).get(detector) for detector in ("ours", "pupil"))
        return [RECORDINGS[key].title, text(ours) if ours else MISSING, text(theirs) if theirs else "-"]

    def arcs(key: str) -> list[str]:
        return row(key, ARCS.format_map, ", without wires")

    lines = ["# Perception on recordings", "", banner([code["commit"]], [code["digest"]]), "", f"Made by `{command}` on {machine()}. This page is generated.",
             INTRODUCTION, *table("recording | what it is | source | licence", (
                 (r.title, r.about, ", ".join(f"`{p}`" for p in r.paths) or "this repository", r.licence) for r in RECORDINGS.values())),
             ODOMETRY, *table("recording | compared | ATE | at the end | attitude | NEES per dimension | restarts | required: at most", (
                 [RECORDINGS[key].title, *(motion(key, results[key]) if key in results else [MISSING])]
                 for key in ("v101", "v101_flight", "mh01", "floor")))]
    if "v101" in results:
        f = results["v101"]
        lines += ["", f"On V1_01 the gyro's bias is {math.hypot(*f['gyro_bias']):.3f} rad/s; rest is detected in "
                  f"{f['frames']['RESTING']} of {f['images']['cam0']} frames. The estimator's attitude is wrong by "
                  f"{f['estimator']['attitude_rms_deg']:.2f} deg from the start on.", V101]
    if "v101_flight" in results:
        lines += [FLIGHT]
    if "mh01" in results:
        lines += [MH01]
    if "l515" in results:
        frames = results["l515"]["frames"]
        lines += ["", L515.format_map({**results["l515"], "tracked": frames.get("TRACKING", 0), "all": sum(frames.values())})]
    if "racing" in results:
        required_here = f"required: at most {RACING_ERROR_MAX} %, NEES {NEES_MAX:g}"
        lines += [RACING, *table(f"flight | path | final error of each seed | {required_here} | NEES per dimension | frames lost",
                                 map(race, results["racing"]["flights"]))]
    return [*lines, TAGS, *table("recording | ours | pupil-apriltags", (
        pair("nasa", corners), pair("rotation", TURNS.format_map),
        pair("rooms", ROOMS.format_map),
        [*row("aprilgrid", grid), "-"], [*row("floor", board), "-"], [*row("clipboard", POSES.format_map, ", poses of six tags"), "-"])),
            WIRES, *table("recording | found", (
                row("pldu", WIRES_TRACED.format_map), row("pldm", WIRES_TRACED.format_map), row("street", judged),
                arcs("rotation"), arcs("rooms"), arcs("nasa"),
                *(row(key, IN_MAP.format_map, ", without wires") for key in ("v101", "floor")))), END]


# -- the command -----------------------------------------------------------------------------------------------------


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("recordings.py", __doc__, EXAMPLES)
    out.add_argument("folder", type=Path, metavar="FOLDER", help="with the repositories in FOLDER/owner/name")
    out.add_argument("--only", choices=RECORDINGS, metavar="NAME",
                     help=f"score one of {', '.join(RECORDINGS)}; the others keep their figures of the same code")
    out.add_argument("--out", type=Path, default=root() / "docs/results/recordings", metavar="DIR", help="of the page")
    return out


def score(arguments: argparse.Namespace) -> int:
    """Score the available recordings and write the page."""
    there = [path for recording in RECORDINGS.values() for path in recording.paths if (arguments.folder / path).exists()]
    if not (there or arguments.only and arguments.folder.is_dir()):  # the page would lose every recording
        raise ConfigError("FOLDER", str(arguments.folder), "is no folder with recordings; --help shows how to clone them")
    signal.signal(signal.SIGINT, signal.default_int_handler)
    data = output_folder(arguments.out) / "results.json"
    single_threaded_blas()
    before = json.loads(data.read_text()) if arguments.only and data.is_file() else {}
    made_by = "python3 bench/recordings.py FOLDER"
    code = code_version()
    head = {**code, "command": made_by, "machine": machine()}
    results: dict[str, Figures] = before["recordings"] if before.get("digest") == code["digest"] != "" else {}
    for key, recording in RECORDINGS.items():
        if arguments.only not in (None, key):
            continue
        missing = [path for path in recording.paths if not (arguments.folder / path).exists()]
        for path in missing:
            repository = "/".join(path.split("/")[:2])
            print(f"{key}: {arguments.folder / path} is missing: git clone https://github.com/{repository} {arguments.folder / repository}")
        if not missing:
            places = [arguments.folder / path for path in recording.paths] or [root() / "tests" / "recordings", arguments.out]
            results[key] = finite(recording.score(*places))
            print(f"{key}: {json.dumps(results[key])}", flush=True)
        write_json(data, {**head, "recordings": results})
    (arguments.out / "README.md").write_text("\n".join(page(results, made_by, code)) + "\n")
    return 0


main = command(parser, score)

if __name__ == "__main__":
    sys.exit(main())
