"""What a component under test has emitted."""

from collections import defaultdict

from perch_core.component import Output, ports


class Outputs:
    """Everything that a component emits, by port: `outputs["odometry"]`."""

    def __init__(self, component):
        self._values = defaultdict(list)
        for port in ports(type(component), Output):
            getattr(component, port.name).receivers.append(self._values[port.name].append)

    def __getitem__(self, port):
        return self._values[port]

    def warnings(self):
        """Texts of the warnings so far."""
        return [line.text for line in self._values["log"] if line.level == "warning"]
