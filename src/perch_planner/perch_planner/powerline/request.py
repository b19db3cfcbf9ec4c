"""Request of a powerline plan, and the pose at which the vehicle grips. [P:V-A]"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from perch_core import so3
from perch_core.errors import PerchError, PlanningRefusal
from perch_core.lines import Segment, perch_normal
from perch_core.values.limits import TILT

E3 = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class PerchPose:
    """Required end of a perch: pose with free yaw about b3, and velocity.

    Attributes:
        p_WB: position of the centre of mass [m], shape (3,).
        s3_W: required direction of b3, unit, shape (3,).
        v_W: required velocity [m/s], shape (3,).
    """

    p_WB: np.ndarray
    s3_W: np.ndarray
    v_W: np.ndarray = field(default_factory=lambda: np.zeros(3))

    @property
    def q_WB(self) -> np.ndarray:
        """An attitude with b3 = s3, xyzw, shape (4,); its yaw does not matter where the body's x and y radii are equal."""
        half = E3 + self.s3_W
        if np.linalg.norm(half) < 1e-6:
            return np.array([1.0, 0.0, 0.0, 0.0])
        half /= np.linalg.norm(half)
        return np.array([*np.cross(E3, half), half[2]])

    @classmethod
    def at(cls, p_WB: np.ndarray, q_WB: np.ndarray, v_W: np.ndarray | None = None) -> PerchPose:
        """Create a pose from a full one (quaternion xyzw); only b3 of the attitude is used, as the gripper may turn about b3."""
        p_WB, q_WB = np.array(p_WB, float), np.array(q_WB, float)
        norm = float(np.linalg.norm(q_WB))
        if not abs(norm - 1) < 1e-2:
            raise PlanningRefusal("bad_input", "perch pose", -abs(norm - 1), f"perch quaternion has norm {norm:.4f}, not 1")
        return cls(p_WB, so3.quat_to_matrix(q_WB / norm)[:, 2], np.zeros(3) if v_W is None else np.array(v_W, float))

    @classmethod
    def on_line(cls, line: Segment, point: np.ndarray, pitch: float, offset: float, side_W: np.ndarray,
                v_W: np.ndarray | None = None) -> PerchPose:
        """Create a pose from a point of a line and a pitch about the line, see `perch_core.lines.perch_normal`.

        Args:
            line: the line to grip.
            point: point near the line in W [m], shape (3,); the nearest point of the line is used.
            pitch: tilt about the line, in [0, pi] [rad].
            offset: from the wire's axis to the centre of mass along b3 [m].
            side_W: a point in W on the side that the vehicle comes from [m], shape (3,).
            v_W: required velocity at the end [m/s].

        Raises:
            PlanningRefusal: pitch out of range, not finite, or a vertical line.
        """
        if TILT.problem(pitch):
            raise PlanningRefusal("bad_input", "perch pitch", -1.0, f"perch pitch {pitch:g} rad is outside [0, pi]")
        grip = line.closest_point(np.array(point, float))
        try:
            s3_W = perch_normal(line, grip, pitch, side_W)
        except PerchError as error:
            raise PlanningRefusal("bad_input", "perch pitch", -1.0, f"{error}; give a pose") from error
        return cls(grip + offset * s3_W, s3_W, np.zeros(3) if v_W is None else np.array(v_W, float))


@dataclass(frozen=True)
class PowerlineRequest:
    """One manoeuvre to plan.

    Attributes:
        start: state, shape (17,), see `rotor_model`.
        lines: all segments to avoid, the target among them.
        target_line: id of the segment to perch on.
        perch: required end of the perch; None only with `recovery_only`.
        perception: keep the target line in view. [P:eq8-13]
        with_recovery: append the recovery. [P:V-B]
        recovery_only: plan a recovery from `start` alone.
        hover: target position of a recovery [m], shape (3,); None: that of the start.
        solver: first choice, "fatrop" or "ipopt"; where it does not converge, ipopt is tried.
        deadline: wall-clock time after which no further attempt is begun [s]; 0: the settings'.
    """

    start: np.ndarray
    lines: tuple[Segment, ...]
    target_line: int
    perch: PerchPose | None = None
    perception: bool = False
    with_recovery: bool = True
    recovery_only: bool = False
    hover: np.ndarray | None = None
    solver: str = "fatrop"
    deadline: float = 0.0

    def target(self) -> Segment:
        """The line to perch on.

        Raises:
            PlanningRefusal: the map is empty or does not contain the line.
        """
        for line in self.lines:
            if line.id == self.target_line:
                return line
        known = ", ".join(str(line.id) for line in self.lines) or "none"
        raise PlanningRefusal("empty_map", "target line", -1.0,
                              f"target line {self.target_line} is not in the map (lines: {known}); map the lines first")
