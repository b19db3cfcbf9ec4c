"""Report files of a planned problem: the trajectory as CSV, figures and checks as JSON, pictures."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from perch_core import config
from perch_core.errors import PlanningRefusal
from perch_core.json_values import write_json
from perch_core.rotor_model import THRUST
from perch_planner.powerline.plan import Manoeuvre
from perch_planner.powerline.problem import PlannedProblem
from perch_planner.powerline.visibility import visibility

COLUMNS = ("t", "p_x", "p_y", "p_z", "q_x", "q_y", "q_z", "q_w", "v_x", "v_y", "v_z", "w_x", "w_y", "w_z", "a_x", "a_y", "a_z",
           "dw_x", "dw_y", "dw_z", "rotor_1", "rotor_2", "rotor_3", "rotor_4")


def write_csv(planned: PlannedProblem, path: Path) -> None:
    """Write all samples of perch and recovery in SI units; quaternions xyzw."""
    t = planned.plan.trajectory(planned.planner.solver.model)
    rows = np.column_stack([t.times, t.p, t.q, t.v, t.w, t.a, t.dw, t.rotor_thrust])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        writer.writerows([f"{value:.9g}" for value in row] for row in rows)


def summary(planned: PlannedProblem) -> dict[str, Any]:
    """Durations, solver figures, certificates and visibility of a plan, ready for JSON."""
    parts = {}
    for name, part in (("perch", planned.plan.perch), ("recovery", planned.plan.recovery)):
        if part is not None:
            parts[name] = {"duration_s": part.duration, "solve_time_s": part.solve_time, "cpu_time_s": part.cpu_time,
                           "iterations": part.iterations, "solver": part.solver, "intervals": part.intervals, "cost": part.cost,
                           "peak_rotor_thrust_N": float(part.states[:, THRUST].max()), "least_height_m": float(part.states[:, 2].min())}
    certificates = [{"quantity": b.quantity, "unit": b.unit, "minimum": b.minimum, "maximum": b.maximum,
                     "lower_limit": b.lower_limit, "upper_limit": b.upper_limit, "margin": b.margin,
                     "holds": b.holds} for b in planned.plan.bounds]
    out = {"problem": planned.problem.name, "vehicle": planned.vehicle.name, "compiled": planned.planner.solver.compiled,
           **parts, "without_recovery": planned.plan.without_recovery, "certificates": certificates}
    if planned.plan.perch is not None:
        mount = planned.vehicle.mounts[planned.problem.settings.camera]
        out["visibility"] = visibility(planned.plan.perch.states, planned.request.target(), mount).summary()
    return out


def _without_awareness(planned: PlannedProblem) -> Manoeuvre | None:
    """Plan the perch of a perception-aware plan again without awareness; None where there is nothing to compare."""
    if not planned.request.perception:
        return None
    try:
        return planned.planner.plan(config.replace(planned.request, perception=False, with_recovery=False)).perch
    except PlanningRefusal:  # the plan itself stands
        return None


def write_report(planned: PlannedProblem, folder: Path, animation: bool = False) -> dict[str, Any]:
    """Write `plan.csv`, `plan.json`, `plan.png`, for a perch `visibility.png`, and optionally `plan.gif`.

    A plan with perception awareness is drawn beside the same perch without it, where there is one.

    Args:
        planned: the planned problem.
        folder: output folder, created where it is missing.
        animation: also write `plan.gif`.

    Returns:
        The content of the JSON file, with the files' names under "files".
    """
    from perch_planner.powerline import picture  # matplotlib is slow to load

    folder.mkdir(parents=True, exist_ok=True)
    paths = [folder / "plan.csv", folder / "plan.json", folder / "plan.png"]
    write_csv(planned, paths[0])
    picture.draw_manoeuvre(planned, paths[2])
    if planned.plan.perch is not None:
        paths.append(folder / "visibility.png")
        picture.draw_visibility(planned, paths[-1], _without_awareness(planned))
    if animation:
        paths.append(folder / "plan.gif")
        picture.draw_animation(planned, paths[-1])
    out = summary(planned)
    write_json(paths[1], out)
    return {**out, "files": [str(path) for path in paths]}
