"""Which flights are worth a closer look: failures of every cause, then the narrowest successes."""

from __future__ import annotations

from collections import defaultdict

from perch_eval.campaign.causes import SUCCESS
from perch_eval.campaign.results import RunResult


def severity(result: RunResult) -> float:
    """How far from a good contact a flight was; larger is worse. Flights without a contact count by their tracking."""
    m = result.metrics

    def of(name: str) -> float:
        return m.get(name) or 0.0

    return (of("contact_tilt_error_deg") / 15.0 + of("contact_tangential_speed_m_s") / 0.6 + of("contact_offset_m") / 0.3
            + sum(of(f"tracking_rmse_m_{axis}") for axis in "xyz") / 0.3)


def worst(found: list[RunResult], count: int) -> list[RunResult]:
    """The worst flights: in turn one of each cause, the frequent causes first, the severest first within a cause.

    Runs that could not be carried out have nothing to show and are left out.
    """
    groups: dict[str, list[RunResult]] = defaultdict(list)
    for result in found:
        if result.cause not in (SUCCESS, "error"):
            groups[result.cause].append(result)
    order = sorted(groups.values(), key=lambda group: (-len(group), group[0].cause))
    for group in order:
        group.sort(key=lambda r: (-severity(r), r.number))
    turns = [group[k] for k in range(max(map(len, order), default=0)) for group in order if k < len(group)]
    good = sorted((r for r in found if r.cause == SUCCESS), key=lambda r: (-severity(r), r.number))
    return (turns + good)[:count]
