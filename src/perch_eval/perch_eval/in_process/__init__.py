"""Flights in one process, without ROS: the components that fly, moved by the schedule of every simulated flight.

`fly` flies a scenario; `arrange` gives the same flight for whoever wants to replace a component, to disturb what reaches it, or
to act between two steps.
"""

from perch_eval.in_process.flights import Sensing, arrange, fly
from perch_eval.in_process.loop import Loop
from perch_eval.in_process.trace import FlightTrace

__all__ = ["FlightTrace", "Loop", "Sensing", "arrange", "fly"]
