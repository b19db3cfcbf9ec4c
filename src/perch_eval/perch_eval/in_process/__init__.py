"""The stack's algorithm cores stepped in one process, without DDS: the same flight, many times faster.

Each module mirrors one node's wiring and nothing of its algorithm; the order of events within a step is that of the
lockstep (docs/architecture.md). `tests/system/test_campaign_engines.py` holds both against each other.
"""

from perch_eval.in_process.engine import Sensing, fly
from perch_eval.in_process.trace import FlightTrace

__all__ = ["FlightTrace", "Sensing", "fly"]
