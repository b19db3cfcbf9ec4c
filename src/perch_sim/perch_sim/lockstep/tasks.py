"""Tasks of all possible participants of a flight: their order, what triggers them, and their latency in simulation time."""

from __future__ import annotations

from typing import NamedTuple

from perch_sim.scenario import Latency

START = 1_000_000_000  # stamp at which a flight begins: ROS reads zero as "no time yet" [ns]
START_DEADLINE = START + 100_000_000  # until then a flight may wait for its first goal [ns]
DECISION_STEPS = 10   # the mission decides at 50 Hz
RECORDING_STEPS = 50  # the recorder writes every 0.1 s of flight within 0.1 s, so that the flight cannot outrun the disk
RECORDING_TIME = 0.1  # [s]


class Task(NamedTuple):
    """Trigger and latency of a participant's work.

    Attributes:
        latency: time from the middle of an exposure, or from a step, to when the results take effect [s]; None: the participant
            works at every step, and its results take effect at once.
        period: steps from one batch to the next; 0: one batch per frame of its cameras.
    """

    latency: float | None = None
    period: int = 0


def flight_tasks(latency: Latency) -> dict[str, Task]:
    """Return the tasks of all participants by name, in the order in which they work within a step."""
    return {
        "estimator": Task(),
        "controller": Task(),
        "vio": Task(latency.vio),
        "vio_model": Task(latency.vio),
        "target_localizer": Task(latency.target_localizer),
        "powerline_mapper": Task(latency.powerline_mapper),
        "mission": Task(latency.mission, DECISION_STEPS),
        "recorder": Task(RECORDING_TIME, RECORDING_STEPS),
    }


PARTICIPANTS = tuple(flight_tasks(Latency()))
"""Names of all possible participants."""


def is_slow(name: str) -> bool:
    """Return whether the results of a participant take effect later than at its step."""
    task = flight_tasks(Latency()).get(name)
    return task is not None and task.latency is not None
