"""Speed and accuracy of the tag pipeline on rendered images; part of `python3 scripts/bench.py perception`."""

from __future__ import annotations

import time
from collections.abc import Callable

import cv2
import numpy as np
from harness import Figure, figure
from perch_core import so3
from perch_core.tag_board import load_board
from perch_core.vehicle import load_vehicle
from perch_perception.pose_buffer import BodyState
from perch_perception.tags import BoardLocalizer, TagDetector, refine_corners
from perch_sim.rendering import Renderer, build_scene
from perch_sim.scenario import load_scenario
from recordings_scores import ours_of, pupil

# scenario, name, bars on position [cm] and attitude [deg]
PLACES = (("surface_60", "60 deg, 1.7 m", 0.5, 0.3), ("surface_90", "90 deg, 1.7 m", 0.5, 0.3),
          ("surface_60_far", "60 deg, 3 m", 1.0, 1.0), ("surface_90_far", "90 deg, 3 m", 1.0, 1.0))


def figures(quick: bool) -> list[Figure]:
    """Measure hovers in front of each pad: search, then tracking, with each frame timed and compared with the truth."""
    cv2.setNumThreads(1)
    hovers, frames = (5, 4) if quick else (42, 6)
    out: list[Figure] = []
    first, tracking, acquired, flips = [], [], [], 0
    for scenario, name, bar_cm, bar_deg in PLACES:
        errors = []
        for error, searched, seconds in _sightings(scenario, hovers, frames, acquired):
            (first if searched else tracking).append(1e3 * seconds)
            if error is not None:
                errors.append(error)
        errors = np.array(errors or [(np.nan, np.nan)])  # which meets no bar
        flips += int(np.sum(errors[:, 1] > np.radians(10.0)))
        out += [figure(f"tags: position error, {name}", "cm", 100 * errors[:, 0], bar_cm),
                figure(f"tags: attitude error, {name}", "deg", np.degrees(errors[:, 1]), bar_deg),
                figure(f"tags: attitude p90, {name}", "deg", [np.degrees(np.percentile(errors[:, 1], 90))], 2.0)]
    everything = [figure("tags: frame", "ms", tracking + first, 8.0),
                  figure("tags: frame, tracking", "ms", tracking, 8.0),
                  figure("tags: frame, searching (10 Hz at most)", "ms", first),
                  figure(f"tags: all four within {frames} frames", "share", [float(np.mean(acquired))], 0.99, "min >="),
                  figure("tags: flips", "frames", [float(flips)], 0.0, "max ==")]
    return everything + out + (_compare_with_pupil(hovers, search) if (search := pupil()) else [])


def _compare_with_pupil(hovers: int, search: Callable[[np.ndarray], list]) -> list[Figure]:
    """Compare our corners with those of pupil-apriltags (`pip install pupil-apriltags`, no lens model) in the same images."""
    out = []
    for scenario_name, name, _, _ in PLACES:
        scenario = load_scenario(scenario_name)
        mount, board = load_vehicle(scenario.vehicle).mounts["front"], load_board(scenario.target.board)
        renderer, surface, rng = Renderer(build_scene(scenario, seed=5), mount, seed=5), scenario.surface, np.random.default_rng(5)
        errors: dict[str, list[np.ndarray]] = {"ours": [], "pupil-apriltags": []}
        for _ in range(hovers):
            p_WB, R_WB = np.array([0.0, 0.0, scenario.mission.takeoff_height]) + rng.normal(0, 0.08, 3), so3.exp(rng.normal(0, 0.05, 3))
            image, (p_WC, R_WC) = renderer.render([(p_WB, R_WB)], rng), mount.pose(p_WB, R_WB)
            truth = mount.camera.project((board.corners_S @ surface.R_WS.T + surface.p_WS - p_WC) @ R_WC)[0]
            found = TagDetector(board, mount.camera).search(image)
            refined = refine_corners(image, mount.camera, found.corners, modules=board.modules)
            errors["ours"] += [np.linalg.norm(corners - truth[board.ids.index(number)], axis=1)
                               for number, corners in zip(found.ids, mount.camera.project(refined.rays_C)[0])]
            errors["pupil-apriltags"] += [np.linalg.norm(ours_of(tag.corners) - truth[board.ids.index(tag.tag_id)], axis=1)
                                          for tag in search(image) if tag.tag_id in board.ids]
        for detector, each in errors.items():
            out += [figure(f"tags: found by {detector}, one search, {name}", "share", [len(each) / (hovers * len(board.ids))])]
            out += [figure(f"tags: corners by {detector}, {name}", "px", np.concatenate(each))] if each else []
    return out


def _sightings(scenario_name, hovers, frames, acquired):
    """Yield per frame the errors (position [m], attitude [rad]) or None, whether it was a search, and the time taken [s]."""
    scenario = load_scenario(scenario_name)
    mount = load_vehicle(scenario.vehicle).mounts["front"]
    renderer = Renderer(build_scene(scenario, seed=5), mount, seed=5)
    board, surface = load_board(scenario.target.board), scenario.surface
    rng = np.random.default_rng(5)
    for _ in range(hovers):
        localizer = BoardLocalizer(board, mount)
        start, tags = np.array([0.0, 0.0, scenario.mission.takeoff_height]) + rng.normal(0, 0.08, 3), 0
        for k in range(frames):
            p_WB, R_WB = start + rng.normal(0, 0.01, 3), so3.exp(rng.normal(0, 0.05, 3))
            image = renderer.render([(p_WB, R_WB)], rng)
            state = BodyState(k / 30, p_WB, so3.quat_from_matrix(R_WB), np.zeros(3), np.zeros(3))
            begin = time.perf_counter()
            result = localizer.process(image, k / 30, state)
            seconds = time.perf_counter() - begin
            error = None
            if result.board is not None:
                p_WC, R_WC = mount.pose(p_WB, R_WB)
                error = (np.linalg.norm(R_WC.T @ (surface.p_WS - p_WC) - result.board.p_CS),
                         np.linalg.norm(so3.log(R_WC.T @ surface.R_WS @ result.board.R_CS.T)))
                tags = max(tags, len(result.board.ids))
            yield error, result.searched, seconds
        acquired.append(tags == len(board.ids))
