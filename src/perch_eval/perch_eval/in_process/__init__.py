"""Flights in one process, without ROS: the components of the nodes, executed by the schedule of every simulated flight.

`fly` flies a scenario; `arrange` returns the same flight before its first step, to replace components, to disturb their inputs,
or to act between two steps.
"""

from perch_eval.in_process.flights import Sensing, arrange, fly
from perch_eval.in_process.loop import Loop
from perch_eval.in_process.trace import FlightTrace

__all__ = ["FlightTrace", "Loop", "Sensing", "arrange", "fly"]
