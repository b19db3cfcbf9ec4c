"""[P] section III: approximation of a catenary of 185 m by 15 straight segments."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from scipy.optimize import brentq

from perch_core.catenary import Catenary, fit_segments
from perch_eval.evaluation.document import Effort, Section

LENGTH, COUNT, MEAN_LENGTH, MEAN_ERROR = 185.0, 15, 12.0, 0.015
SAG_SHARE = 0.025  # of the span: usual for distribution and transmission lines at everyday temperature


def cable_of_length(length: float, sag_share: float) -> Catenary:
    """Return a level cable of a given length [m] whose sag is a given share of its span."""
    def cable(span: float) -> Catenary:
        return Catenary.from_sag(np.zeros(3), np.array([span, 0.0, 0.0]), sag_share * span)

    return cable(brentq(lambda span: cable(span).length - length, 0.5 * length, length))


def cable_sections(effort: Effort) -> list[Section]:
    """Return the segments' errors and lengths beside the paper's values for its 185 m line."""
    cable = cable_of_length(LENGTH, SAG_SHARE)
    fit = fit_segments(cable, COUNT)
    lengths = np.linalg.norm(np.diff(fit.vertices, axis=0), axis=1)
    share = brentq(lambda s: fit_segments(cable_of_length(LENGTH, s), COUNT).mean_error - MEAN_ERROR, 0.005, 0.08)
    out = Section("p_catenary", "[P] section III: a real line as straight segments",
                  f"A level catenary of {LENGTH:g} m with a sag of {100 * SAG_SHARE:g} % of its span ({cable.sag:.2f} m); the paper does "
                  "not give the sag of its line. Errors are exact, not sampled.")
    out.claim(f"mean error of {COUNT} segments", f"{100 * fit.mean_error:.2f} cm", f"{100 * MEAN_ERROR:g} cm",
              fit.mean_error <= MEAN_ERROR, "at most the paper's")
    out.show("greatest error", f"{100 * fit.max_error:.2f} cm")
    out.show("mean segment length", f"{lengths.mean():.1f} m", f"{MEAN_LENGTH:g} m", "follows from length and number")
    out.show("sag at which the mean error is the paper's 1.5 cm", f"{100 * share:.2f} % of the span")
    counts = np.arange(3, 41)
    errors = [fit_segments(cable, int(n)).mean_error for n in counts]
    figure = Figure(figsize=(9.0, 5.2), layout="constrained")
    above, below = figure.subplots(2, 1)
    points = cable.sample(400)
    above.plot(points[:, 0], points[:, 2], lw=1.0, label="catenary")
    above.plot(fit.vertices[:, 0], fit.vertices[:, 2], "o-", ms=3, lw=0.8, label=f"{COUNT} segments")
    above.set(xlabel="along the line [m]", ylabel="below the supports [m]")
    below.semilogy(counts, 100 * np.array(errors), lw=1.2)
    below.plot([COUNT], [100 * MEAN_ERROR], "r*", label="paper")
    below.set(xlabel="segments", ylabel="mean error [cm]")
    for axes in (above, below):
        axes.grid(alpha=0.3)
        axes.legend(fontsize=8)
    figure.savefig(effort.out / "p_catenary.png", dpi=110)
    out.figures.append(("p_catenary.png", "The line, its segments, and the error over their number"))
    out.data = {"counts": counts.tolist(), "mean_error_m": errors}
    return [out]
