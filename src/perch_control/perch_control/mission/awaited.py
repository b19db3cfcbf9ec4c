"""What a mission waits for: silent channels, planners that do not answer, and the nodes that owe the values."""

from __future__ import annotations

import math
from collections.abc import Mapping

from perch_core.values import NANOSECONDS, ControllerStatus, EstimatorHealth, OdometryState, nanoseconds, seconds
from perch_control.mission.running_goal import RunningGoal
from perch_control.mission.targets import Targets
from perch_control.mission.values import Phase

OVERDUE = 3 * NANOSECONDS  # a value that is awaited for longer is reported [ns]
SOURCES = {
    "/clock": "vehicle", "imu/data_raw": "vehicle", "vio/odometry": "vio", "odometry": "estimator", "estimator/status": "estimator",
    "controller/status": "controller", "target/pose": "target_localizer", "powerlines": "powerline_mapper",
    "plan_perch": "perching_planner", "plan_way_out": "perching_planner", "plan_powerline": "powerline_planner",
}
"""Channel or service -> node that sends its values or answers."""


def awaited(running: RunningGoal, imu: int | None, odometry: OdometryState | None, estimator: EstimatorHealth | None,
            controller: ControllerStatus | None, targets: Targets) -> dict[str, int | None]:
    """Return what a goal waits for at present, as `newest` of `overdue`.

    Args:
        running: the goal.
        imu: stamp of the newest IMU sample [ns].
        odometry, estimator, controller: newest value of their channels; None: there was none yet.
        targets: newest values of the perception nodes.
    """
    values = {"odometry": odometry, "estimator/status": estimator, "controller/status": controller}
    newest = {"imu/data_raw": imu, **{channel: None if value is None else value.stamp for channel, value in values.items()}}
    if estimator is not None and not estimator.vio_age <= seconds(OVERDUE):  # VIO's messages are received by the estimator alone
        newest["vio/odometry"] = estimator.stamp - nanoseconds(estimator.vio_age) if math.isfinite(estimator.vio_age) else None
    if running.machine.phase is Phase.SEARCHING:
        newest[running.machine.target_channel] = targets.newest(running.machine.target_channel)
    if running.machine.phase is not Phase.RECOVERING:
        requests = (running.pending, running.way_out)
        newest |= {request.channel: request.made for request in requests if request is not None and request.answer is None}
    return newest


def overdue(now: int, since: int, newest: Mapping[str, int | None]) -> str:
    """Return which awaited values are overdue, and which nodes owe them; empty: none.

    Args:
        now: present time [ns].
        since: earliest time from which a value has been awaited [ns].
        newest: channel -> stamp of its newest value; service -> time of the request; None: there was none yet [ns].
    """
    late = [channel for channel, stamp in newest.items() if now - (since if stamp is None else max(since, stamp)) > OVERDUE]
    return ", ".join(f"no {channel} from {SOURCES[channel]}" for channel in late) + f" for {OVERDUE // NANOSECONDS} s" if late else ""


def overdue_at_start(waited: int, ticked: int, newest: Mapping[str, int | None]) -> str:
    """Return what is overdue before the first odometry, when there is no stamp to compare with.

    Args:
        waited: time of the wait [ns].
        ticked: time of the wait as counted in ticks; where it is far longer, simulated time stands still [ns].
        newest: as in `overdue`.
    """
    clock = ["/clock"] if ticked - waited > OVERDUE else []
    return overdue(max(waited, ticked), 0, dict.fromkeys([*clock, *(channel for channel, stamp in newest.items() if stamp is None)]))
