"""The line that says how far a campaign is."""

import io

from perch_eval.campaign.progress import Progress, with_progress


def lines(total: int | None) -> str:
    progress = Progress(total, unit="flights", out=io.StringIO(), period=0.0)
    for good in (True, False):
        progress.add(good)
    return progress.line(progress._began + 60.0)


def test_the_rest_is_told_where_the_total_is_known():
    assert lines(4) == "  2/4 flights, 1 good (50 %), 2.0 per minute, 60 s left"
    assert lines(None) == "  2 flights, 1 good (50 %), 2.0 per minute"


def test_what_nobody_judges_is_counted_on_its_way():
    out = io.StringIO()
    assert list(with_progress(iter("abc"), 3, unit="messages", out=out)) == ["a", "b", "c"]
    assert out.getvalue().startswith("  3/3 messages, ") and "good" not in out.getvalue() and out.getvalue().count("\n") == 1
