"""The true state as an estimate."""

from __future__ import annotations

from closed_loop.plant import NoParameters
from perch_core.component import Component, Input, Output
from perch_core.values import EstimatorHealth, OdometryState

STATUS_PERIOD = 100_000_000  # [ns]
RUNNING = 1


class TruthEstimator(Component[NoParameters]):
    """The true state as `odometry`, in the place of the estimator."""

    config_type = NoParameters

    truth = Input(OdometryState, "ground_truth/odometry")
    odometry = Output(OdometryState, "odometry")
    status = Output(EstimatorHealth, "estimator/status")

    def __init__(self, config: NoParameters = NoParameters()) -> None:
        super().__init__(config)
        self._next = 0

    def on_truth(self, state: OdometryState) -> None:
        """Pass a state on."""
        self.odometry(self.believed(state))
        if state.stamp >= self._next:
            self._next = state.stamp + STATUS_PERIOD
            self.status(EstimatorHealth(state.stamp, RUNNING, 0.0, 0, 0, 0.0, (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, "the truth"))

    def believed(self, state: OdometryState) -> OdometryState:
        """What is believed of a true state."""
        return state
