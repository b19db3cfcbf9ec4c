"""Contacts beyond the papers: body rates of perches on a wall, and overhanging surfaces."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict

from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.engines import Task
from perch_eval.campaign.results import RunResult
from perch_eval.campaign.specification import load_campaign
from perch_eval.evaluation.document import Effort, Section, table, write_page
from perch_eval.evaluation.kept import cached_runs
from perch_eval.evaluation.perching import perches
from perch_eval.metrics import FIGURES
from perch_eval.statistics import Rate, Spread

CAMPAIGNS = ("aggressive", "overhang")
"""Names in config/campaigns."""
VARIED = {"parameters.perching_planner.impact_acceleration": "impact acceleration {:g} m/s^2", "target.inclination_deg": "{:g} deg",
          "target.height": "height {:g} m"}
"""Quantity that these campaigns vary -> text of its value."""
COLUMNS = {"max_body_rate_deg_s": 0, "contact_normal_speed_m_s": 2, "contact_tangential_speed_m_s": 2, "contact_tilt_error_deg": 1}
"""Metric of a flight -> number of decimals."""


def contact_sections(effort: Effort) -> list[Section]:
    """Return the success rate under each condition; write `contact.md` and `contact.json`."""
    out = Section("c_contact", "Contacts", "Body rate against success at a wall, and surfaces that hang over: the campaigns of that name in "
                  "config/campaigns, cameras by their error models. Speeds and tilt at each contact: [contact.md](contact.md).")
    groups = {f"`{name}`, cameras rendered": flights for name, flights in perches(effort).items()}
    text = ["# Contacts", "", "Median [range] over the flights that perched. The velcro holds from 0.2 to 1.0 m/s into the surface, up to 0.6 m/s "
            "along it and 15 deg of tilt error. A campaign is flown again by `python3 scripts/campaign.py NAME`.",
            "", "## Conditions of the papers", "", *_table(groups)]
    data = {"papers": [asdict(r) for flights in groups.values() for r in flights]}
    for name in CAMPAIGNS:
        campaign = load_campaign(name)
        found = cached_runs(effort, name, [Task.from_campaign(campaign, run) for run in campaign.runs])
        data[name], groups = [asdict(r) for r in found], {}
        for r in found:
            groups.setdefault(", ".join(VARIED[key].format(value) for key, value in r.values.items()), []).append(r)
        text += ["", f"## Campaign `{name}`", "", f"{campaign.description[0].upper()}{campaign.description[1:]}.", "", *_table(groups)]
        for condition, flights in groups.items():
            out.show(f"{name}: {condition}", str(_rate(flights)), note=_others(flights))
    write_page(effort, "contact", text, data)
    return [out]


def _table(groups: dict[str, list[RunResult]]) -> list[str]:
    head = " | ".join(("condition", "perched", "others", *(f"{FIGURES[name][0]} [{FIGURES[name][1]}]" for name in COLUMNS)))
    return table(head, ((condition, f"{_rate(flights).successes} of {len(flights)}", _others(flights), *(
        Spread.from_values(r.metrics.get(name) for r in flights if r.cause == SUCCESS).to_text(FIGURES[name][2], digits)
        for name, digits in COLUMNS.items()))
        for condition, flights in groups.items()))


def _rate(flights: Sequence[RunResult]) -> Rate:
    return Rate.from_outcomes(r.cause == SUCCESS for r in flights)


def _others(flights: Sequence[RunResult]) -> str:
    """Return the causes of the failed flights with their counts, as text."""
    return ", ".join(f"{n} {cause.replace('_', ' ')}" for cause, n in Counter(r.cause for r in flights if r.cause != SUCCESS).most_common())
