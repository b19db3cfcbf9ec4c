"""What the report says about deadlines, from recorded diagnostics."""

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue

from perch_eval.metrics import missed_deadlines


class Recording:
    """The diagnostics of a flight: (node, values) in order."""

    def __init__(self, *reports):
        self.reports = reports

    def messages(self, topic):
        assert topic == "diagnostics"
        for k, (node, values) in enumerate(self.reports):
            status = DiagnosticStatus(name=f"/{node}", values=[KeyValue(key=a, value=str(b)) for a, b in values.items()])
            yield float(k), DiagnosticArray(status=[status])


def test_the_last_counts_of_each_node_are_reported():
    flight = Recording(("controller", {"deadlines": 500, "missed_deadlines": 9}), ("vehicle", {"steps": 500}),
                       ("controller", {"deadlines": 4000, "missed_deadlines": 10}), ("estimator", {"deadlines": 0, "missed_deadlines": 0}))
    assert missed_deadlines(flight) == {"controller": {"deadlines": 4000.0, "missed": 10.0, "missed_percent": 0.25}}


def test_lockstep_has_no_deadlines():
    assert missed_deadlines(Recording(("controller", {"steps": 500, "step_us_median": 80.0}))) == {}
