"""What a controller knows at each step of a flight without rendered images: plant, IMU, VIO model, UKF; no ROS."""

from __future__ import annotations

from collections import deque

from perch_core.scenario import Scenario
from perch_core.timing import CONTROL_PERIOD_NS
from perch_eval.in_process.estimation import Estimation, Odometry
from perch_eval.in_process.mailbox import Mailbox
from perch_eval.in_process.parameters import NodeParameters
from perch_eval.in_process.stamps import seconds
from perch_eval.in_process.vio_source import ModelledVio
from perch_perception.ukf import ImuSample, UkfConfig
from perch_sim.simulation import Output, Simulation
from perch_sim.vio_model import VioModelParameters


class SensedVehicle:
    """Owns the simulation and what is known of it; `step` is one control period.

    Attributes:
        simulation: the vehicle.
        estimation: the estimator.
        odometry, imu: what it and the IMU say at this step; None before the first.
        index: steps so far.
        vio_lost: no VIO pose reaches the estimator any more.
    """

    def __init__(self, scenario: Scenario, params: NodeParameters, seed: int) -> None:
        """
        Raises:
            ConfigError: the scenario or a node's parameter is refused.
        """
        self.simulation = Simulation(scenario, seed)
        self.estimation = Estimation(params.of("estimator", UkfConfig))
        self._vio = ModelledVio(params.of("vio_model", VioModelParameters), self.simulation.vehicle.mounts["down"])
        self._latency = round(scenario.latency.vio * 1e9)
        self._poses, self._frames = Mailbox(), deque()
        self.odometry: Odometry | None = None
        self.imu: ImuSample | None = None
        self.index, self.vio_lost = 0, False

    @property
    def time(self) -> float:
        """[s]"""
        return seconds(self.simulation.time)

    def step(self) -> Output:
        """Fly one period with the motors' present command, and estimate."""
        output = self.simulation.advance()
        stamp = output.time
        self.imu = ImuSample(stamp, tuple(output.imu.gyro.tolist()), tuple(output.imu.accel.tolist()))
        self._vio.see(output.state, self.imu)
        for pose in self._poses.released(stamp):
            if not self.vio_lost:
                self.estimation.add_vio(pose)
        self.odometry = self.estimation.step(self.imu)
        self._look(stamp)
        self.index += 1
        return output

    def _look(self, stamp: int) -> None:
        """A pose counts after the VIO's latency, and never before the next step."""
        camera = self.simulation.cameras["down"]
        if camera.due(stamp) is not None:
            self._frames.append(camera.take())
        while self._frames and self._vio.covers(self._frames[0]):
            delivery = self._frames.popleft()
            pose = self._vio.answer(delivery)
            if pose is not None:
                self._poses.post(max(delivery.frame.middle + self._latency, stamp + CONTROL_PERIOD_NS), pose)
