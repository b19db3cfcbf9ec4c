"""Outputs of a perching plan: CSV samples, JSON with coefficients and certificates, a picture, requirements for the verifier."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np

from perch_core.flatness import FlatState, flat_to_state
from perch_core.vehicle import Vehicle
from perch_planner.contact_constraints import TUBE_FLOOR, TUBE_SHARE, TUBE_STEP
from perch_planner.planner import PerchPlan
from perch_planner.problem import Limits, PerchProblem, PerchSettings, contact_heading
from perch_planner.verifier import Requirements, Rotors

COLUMNS = ("time", "x", "y", "z", "vx", "vy", "vz", "ax", "ay", "az", "yaw", "qx", "qy", "qz", "qw", "wx", "wy", "wz",
           "thrust")


def states(plan: PerchPlan, mass: float) -> tuple[np.ndarray, list[FlatState]]:
    """Times and full states of a plan, every 2 ms and at contact."""
    times = np.append(np.arange(0.0, plan.duration, 0.002), plan.duration)
    at = plan.trajectory.sample_many(times)
    rows = zip(at.p, at.v, at.a, at.j, at.s, *(np.asarray(values).tolist() for values in (at.yaw, at.yaw_rate, at.yaw_acc)))
    return times, [flat_to_state(p, v, a, j, s, yaw, rate, acceleration, mass) for p, v, a, j, s, yaw, rate, acceleration in rows]


def write_csv(path: Path, plan: PerchPlan, mass: float) -> None:
    """Write 2 ms samples: time [s], position, velocity, acceleration in W, yaw, attitude xyzw, rates in B [rad/s], thrust [N]."""
    from perch_core.so3 import quat_from_matrix

    times, full = states(plan, mass)
    at = plan.trajectory.sample_many(times)
    yaw = np.asarray(at.yaw)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(COLUMNS)
        for k, state in enumerate(full):
            row = [times[k], *at.p[k], *at.v[k], *at.a[k], yaw[k], *quat_from_matrix(state.R_WB), *state.w_WB_B,
                   state.thrust]
            writer.writerow([f"{float(v):.9g}" for v in row])


def as_json(plan: PerchPlan) -> dict[str, Any]:
    """Return segments in Bernstein form, certificates, and the number of programs and time of the planning."""
    fields = ("lower_limit", "upper_limit", "minimum", "maximum", "time_of_minimum", "time_of_maximum")
    return {
        "duration": plan.duration, "iterations": plan.iterations, "solve_time": plan.solve_time,
        "segments": [{"duration": float(d), **{k: row.tolist() for k, row in zip(("x", "y", "z", "yaw"), c)}}
                     for d, c in zip(plan.trajectory.durations, plan.trajectory.coefficients)],
        "certificates": [{"quantity": c.quantity, "unit": c.unit, **{f: getattr(c, f) for f in fields},
                          "method": c.method, "holds": c.holds} for c in plan.certificates],
    }


def requirements(problem: PerchProblem, settings: PerchSettings, vehicle: Vehicle) -> Requirements:
    """Return the requirements on a plan as plain numbers for the verifier."""
    settings = settings.for_surface(problem.surface)
    limits, start, surface = Limits.of(settings, vehicle), problem.start, problem.surface
    each = Rotors(np.array(vehicle.inertia), vehicle.allocation, limits.rotor_thrust)
    return Requirements(
        start=np.array([start.p, start.v, start.a, start.j]), start_yaw=(start.yaw, start.yaw_rate),
        end_yaw=contact_heading(surface),
        waypoints=np.array([[np.full(3, np.nan) if x is None else x for x in (w.p, w.v, w.a, w.j)] for w in problem.waypoints]).reshape(-1, 4, 3),
        p_S=surface.p_WS, s1=surface.R_WS[:, 0], s2=surface.R_WS[:, 1], s3=surface.normal, v_S=problem.target_velocity, perch_offset=vehicle.perch_offset,
        mass=vehicle.mass, impact_acceleration=settings.impact_acceleration,
        impact_speed=(settings.impact_speed_min, settings.impact_speed_max), tangential_speed=settings.tangential_speed_max,
        contact_delay=settings.contact_delay,
        tube=(settings.tube_time, TUBE_STEP, TUBE_SHARE, TUBE_FLOOR), thrust=limits.thrust,
        body_rate=limits.body_rate, speed=limits.speed, height=limits.height, extension=limits.extension,
        duration=settings.duration_max, clearance=limits.clearance, rotors=each)


def draw(path: Path, plan: PerchPlan, problem: PerchProblem, limits: Limits, vehicle: Vehicle) -> None:
    """Draw the path in the vertical plane of the approach with thrust arrows, and thrust, velocity and body rate over time."""
    from matplotlib.figure import Figure

    times, full = states(plan, vehicle.mass)
    p = np.array([s.p_WB for s in full])
    heading = problem.surface.heading
    along = np.array([np.cos(heading), np.sin(heading), 0.0])
    figure = Figure(figsize=(11, 7.5), layout="constrained")
    axes = figure.subplots(2, 2)
    side, thrust, speed, rate = axes.ravel()
    x = (p - problem.start.p) @ along
    side.plot(x, p[:, 2], color="tab:blue")
    for k in range(0, len(times), max(len(times) // 24, 1)):
        b3 = full[k].R_WB[:, 2] * full[k].thrust / limits.thrust[1] * 0.25
        side.annotate("", (x[k] + b3 @ along, p[k, 2] + b3[2]), (x[k], p[k, 2]),
                      arrowprops={"arrowstyle": "->", "color": "tab:orange"})
    centre = problem.surface.p_WS + problem.target_velocity * plan.duration
    ends = centre + np.outer([-0.3, 0.3], problem.surface.R_WS[:, 0])
    side.plot((ends - problem.start.p) @ along, ends[:, 2], color="black", linewidth=3)
    for waypoint in problem.waypoints:
        side.plot((waypoint.p - problem.start.p) @ along, waypoint.p[2], "o", color="tab:green")
    side.set(xlabel="along the approach [m]", ylabel="height [m]", title="side view; arrows: thrust")
    side.set_aspect("equal", adjustable="datalim")
    thrust.plot(times, [s.thrust for s in full])
    for bound in limits.thrust:
        thrust.axhline(bound, color="tab:red", linestyle="--")
    thrust.set(xlabel="time [s]", ylabel="thrust [N]", title="collective thrust and its bounds")
    speed.plot(times, [s.v_WB for s in full], label=["x", "y", "z"])
    speed.legend()
    speed.set(xlabel="time [s]", ylabel="velocity [m/s]", title="velocity")
    rate.plot(times, np.degrees([s.w_WB_B for s in full]), label=["x", "y", "z"])
    rate.legend()
    rate.set(xlabel="time [s]", ylabel="body rate [deg/s]", title="body rate")
    for axis in axes.ravel():
        axis.grid(alpha=0.3)
    figure.savefig(path, dpi=110)
