"""A trace read as a recorded flight, and a trace written as one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from rclpy.serialization import serialize_message

from perch_eval.flight import Flight, States
from perch_eval.in_process.messages import events, streams
from perch_eval.in_process.trace import ESTIMATE, TRUTH, FlightTrace
from perch_eval.mcap_log import McapLog, type_name


class TracedFlight(Flight):
    """The flight of a trace, so that the same metrics judge it as a recorded one. States are arrays at once."""

    def __init__(self, trace: FlightTrace) -> None:
        self._trace = trace
        self._raw = {}
        for topic, stamp, msg in events(trace):
            self._raw.setdefault(topic, []).append((stamp * 1e-9, msg))

    def states(self, topic: str) -> States | None:
        """The states of `ground_truth/odometry` or `odometry`."""
        part = {"ground_truth/odometry": TRUTH, "odometry": ESTIMATE}.get(topic)
        if part is None or len(self._trace.stamps) < 2:
            return None
        rows = self._trace.part(part)
        return States(self._trace.times, rows[:, 0:3], rows[:, 3:7], rows[:, 7:10], rows[:, 10:13])

    def reference(self) -> States | None:
        """What the controller wanted while it followed a trajectory."""
        rows = np.array(self._trace.references)
        if len(rows) < 2:
            return None
        return States(rows[:, 0], rows[:, 1:4], rows[:, 4:8], rows[:, 8:11], rows[:, 11:14])


def write(trace: FlightTrace, path: Path) -> None:
    """Write a trace as an MCAP file, as the recorder would have; images and diagnostics it has none."""
    messages = sorted((*events(trace), *streams(trace)), key=lambda item: item[1])
    log = McapLog(path)
    try:
        for topic, msg in {topic: msg for topic, _, msg in messages}.items():
            log.add_topic(f"/{topic}", type_name(type(msg)))
        for topic, stamp, msg in messages:
            log.write(f"/{topic}", serialize_message(msg), stamp)
    finally:
        log.close()
