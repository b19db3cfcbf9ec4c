"""`perch_msgs/Trajectory` to the trajectories of perch_core and back."""

from __future__ import annotations

import numpy as np
from perch_msgs.msg import PolynomialSegment, Trajectory, TrajectoryPoint

from perch_core.errors import PerchError
from perch_core.ros.conversions import pose_arrays, to_array, to_pose, to_seconds, to_stamp, to_vector
from perch_core.trajectory import FlatTrajectory, SampledTrajectory

FRAME = "map"


def flat_message(trajectory: FlatTrajectory) -> Trajectory:
    """Message of a polynomial trajectory; `id` and `at_end` are left to the caller."""
    msg = Trajectory()
    msg.header.frame_id = FRAME
    msg.header.stamp = to_stamp(float(trajectory.start_time))
    for duration, (x, y, z, yaw) in zip(trajectory.durations, trajectory.coefficients):
        msg.segments.append(PolynomialSegment(
            duration=float(duration), x=x.tolist(), y=y.tolist(), z=z.tolist(), yaw=yaw.tolist()))
    msg.recovery_start = -1.0
    return msg


def sampled_message(trajectory: SampledTrajectory) -> Trajectory:
    """Message of a sampled trajectory; `id` and `at_end` are left to the caller."""
    msg = Trajectory()
    msg.header.frame_id = FRAME
    msg.header.stamp = to_stamp(float(trajectory.start_time))
    for i, time in enumerate(trajectory.times):
        point = TrajectoryPoint(
            time_from_start=float(time), pose=to_pose(trajectory.p[i], trajectory.q[i]),
            linear_velocity=to_vector(trajectory.v[i]), angular_velocity=to_vector(trajectory.w[i]),
            linear_acceleration=to_vector(trajectory.a[i]), angular_acceleration=to_vector(trajectory.dw[i]))
        point.rotor_thrust = trajectory.rotor_thrust[i].astype(float)
        msg.points.append(point)
    msg.recovery_start = -1.0
    return msg


def from_message(msg: Trajectory) -> FlatTrajectory | SampledTrajectory:
    """The trajectory that a message carries: the samples where there are any, the polynomials otherwise.

    Raises:
        PerchError: empty, of unequal lengths, not finite, or in another frame than `map`.
    """
    if msg.header.frame_id != FRAME:
        raise PerchError(f"trajectory: header.frame_id {msg.header.frame_id!r} is not {FRAME!r}")
    start = to_seconds(msg.header.stamp)
    try:
        if msg.points:
            return _sampled(msg, start)
        if not msg.segments:
            raise ValueError("it has neither segments nor points")
        rows = [[list(s.x), list(s.y), list(s.z), list(s.yaw)] for s in msg.segments]
        if len({len(row) for segment in rows for row in segment}) != 1:
            raise ValueError("the segments' coefficients are of unequal length")
        return FlatTrajectory(np.array([s.duration for s in msg.segments]), np.array(rows), start)
    except ValueError as error:
        raise PerchError(f"trajectory: {error}") from None


def _sampled(msg: Trajectory, start: float) -> SampledTrajectory:
    poses = [pose_arrays(p.pose) for p in msg.points]
    q = np.array([pose[1] for pose in poses])
    norms = np.linalg.norm(q, axis=1)
    if not np.all(np.abs(norms - 1.0) < 1e-3):
        raise ValueError(f"a quaternion has norm {norms[np.argmax(np.abs(norms - 1.0))]:.4f}, not 1")
    return SampledTrajectory(
        times=np.array([p.time_from_start for p in msg.points]), p=np.array([pose[0] for pose in poses]),
        q=q / norms[:, None], v=np.array([to_array(p.linear_velocity) for p in msg.points]),
        w=np.array([to_array(p.angular_velocity) for p in msg.points]),
        a=np.array([to_array(p.linear_acceleration) for p in msg.points]),
        dw=np.array([to_array(p.angular_acceleration) for p in msg.points]),
        rotor_thrust=np.array([p.rotor_thrust for p in msg.points]), start_time=start)
