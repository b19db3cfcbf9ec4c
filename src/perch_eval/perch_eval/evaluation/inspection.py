"""[P] Fig. 4 and 5: inspection with the line terms in the NMPC, in one flight and over random layouts. [P:VI-A]"""

from __future__ import annotations

import numpy as np

from perch_eval.evaluation.kept import cached_figures
from perch_eval.evaluation.document import Effort, Section
from perch_eval.inspection.figures import metrics_figure, paths_figure
from perch_eval.inspection.flight import fly
from perch_eval.inspection.layout import random_layout
from perch_eval.statistics import Spread
from perch_sim.scenario import load_scenario

SCENARIO, SEED = "inspection", 1
REFERENCE_COLLISIONS = 2
REQUIRED_LAYOUTS = 20  # fewer flights without a collision do not show what the paper's more than 20 do
REQUIRED_GAIN = 5.0  # bar and paper: factor by which the mean reprojection error is reduced


def inspection_sections(effort: Effort) -> list[Section]:
    """Return Fig. 4 and 5 of one flight, and the same measures over random layouts."""
    return [_figures(effort), _layouts(effort)]


def _figures(effort: Effort) -> Section:
    flight = fly(load_scenario(SCENARIO), SEED)
    out = Section("p_fig_4_5", "[P] Fig. 4 and 5: inspection with the constraints in the NMPC",
                  f"Scenario `{SCENARIO}`, seed {SEED}, flown in one process without ROS (plant, IMU, UKF, NMPC); VIO and the map of the cables by "
                  "their error models. Judged by the true lines; "
                  "a line beyond the image's corners counts as at them. "
                  "The reference is the straight lines between the waypoints; the vehicle looks along them first, to map the cables.")
    for name, draw, caption in (("p_fig_4.png", paths_figure, "Reference (dashed, collisions red) and flown path with the heading (green)"),
                                ("p_fig_5.png", metrics_figure, "Clearance (14j), reprojection error (9), cheirality (14h) and segment visibility (14i)")):
        draw(flight).savefig(effort.out / name, dpi=130)
        out.figures.append((name, caption))
    out.claim("collisions", f"{flight.reference.collisions} of the reference, {flight.collisions} flown", "2, 0",
              flight.reference.collisions == REFERENCE_COLLISIONS and flight.collisions == 0 and not flight.message,
              "the reference collides twice, the flight does not, and is flown to its end")
    gain = flight.reference.reprojection / flight.flown.reprojection
    out.claim("mean reprojection error", f"{flight.reference.reprojection:.0f} -> {flight.flown.reprojection:.0f} px, {gain:.1f} times less",
              "500 % better, about 100 px", gain >= REQUIRED_GAIN, f"cut by >= {REQUIRED_GAIN:g} times")
    out.show("line in front (14h), nearest point on the segment (14i)", f"{100 * flight.flown.visibility.cheirality.mean():.1f} %, "
             f"{100 * flight.flown.visibility.segment.mean():.1f} % of the time", "always, but for brief instants")
    return out


def fly_layout(seed: int) -> dict[str, float]:
    """Return the measures of one random layout, with and without the line terms; the seed is used for layout and flights."""
    layout = random_layout(load_scenario(SCENARIO), seed)
    flown, without_lines = fly(layout, seed), fly(layout, seed, with_lines=False)
    return {"seed": seed, "reference_collisions": flown.reference.collisions, "collisions": flown.collisions,
            "collisions_without": without_lines.collisions, "reference_px": flown.reference.reprojection,
            "flown_px": flown.flown.reprojection, "clearance": float(flown.flown.clearance.min()),
            "cheirality": float(flown.flown.visibility.cheirality.mean()), "segment": float(flown.flown.visibility.segment.mean()),
            "completed": not flown.message, "mapped": flown.mapped, "lines": len(flown.lines)}


def _layouts(effort: Effort) -> Section:
    count = effort.layouts
    found = cached_figures(effort, "inspections", range(1, count + 1), fly_layout, lambda r: r["collisions"] == 0)
    out = Section("p_inspection_layouts", "[P:VI-A] Inspection over random layouts",
                  f"{count} random layouts (seeds 1 to {count}) of three cables and six waypoints, in each of which the reference collides "
                  "twice; flown as above, with the same error models. Without the line terms the same controller follows the reference.")
    collisions, twice = sum(r["collisions"] for r in found), sum(r["reference_collisions"] == REFERENCE_COLLISIONS for r in found)
    ended = sum(r["completed"] for r in found)
    holds = collisions == 0 and ended == count and twice == count
    out.claim("collisions", f"{collisions} in {count} layouts, {ended} flown to the end", "none in more than 20 experiments",
              None if holds and count < REQUIRED_LAYOUTS else holds,
              f"0 in at least {REQUIRED_LAYOUTS} layouts; the reference collides twice in {twice} of {count}")
    out.show("cables in the map when the reference begins", f"{sum(r['mapped'] for r in found)} of {sum(r['lines'] for r in found)}", "",
             "the line terms avoid mapped cables only; the others have not been in the camera's view")
    out.show("layouts in which the flight without the line terms hits a cable", f"{sum(r['collisions_without'] > 0 for r in found)} of {count}")
    gains = Spread.from_values(r["reference_px"] / r["flown_px"] for r in found)
    means = [float(np.mean([r[key] for r in found])) for key in ("reference_px", "flown_px")]
    out.claim("mean reprojection error", f"{means[0]:.0f} -> {means[1]:.1f} px, {means[0] / means[1]:.1f} times less", "500 % better, about 100 px",
              means[0] / means[1] >= REQUIRED_GAIN, f"cut by >= {REQUIRED_GAIN:g} times; single layouts: {gains.to_text(1.0, 1, 'times')}")
    out.show("least scaled clearance", Spread.from_values(r["clearance"] for r in found).to_text(1.0, 2, ""), "",
             "0 is contact, 1 is another body radius away")
    out.show("line in front (14h), nearest point on the segment (14i)", f"{100 * min(r['cheirality'] for r in found):.1f} %, "
             f"{100 * min(r['segment'] for r in found):.1f} % of the time in the worst layout", "always, but for brief instants")
    out.data = {"layouts": found}
    return out
