"""Contact with cables: closing of the gripper, and crash if a cable enters the rotors.

The gripper is `perch_offset` below the centre of mass and opens along -b3; it turns freely about its axis. It closes as
soon as the cable is in the claw, or no longer moves into it, while all tolerances of the scenario hold: position, tilt and
speed of the gripper relative to the cable. Tilt is the deviation of b3 from perpendicular to the cable: pitch about the
cable is free. A cable that leaves the gripper's reach without this was missed; the event reports the values when nearest.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from perch_core import so3
from perch_core.values import Contact
from perch_sim.attachment import FREE, Attachment
from perch_sim.contact_event import ContactState
from perch_sim.dynamics import Hold
from perch_sim.scenario import Cable, Grip

TOUCH = 0.01       # nearer than this the cable is in the claw [m]
LEAVING = 0.02     # ... and it has left when it is this far beyond the tolerance of position [m]
MAX_ERROR = 1e-3   # of the straight pieces for a cable [m]


class Nearest(NamedTuple):
    """Point of a cable that is nearest to a given point."""

    point_W: np.ndarray      # (3,) [m]
    direction: np.ndarray    # of the cable there, unit, (3,)
    distance: float          # [m]


class CableLine:
    """A cable, approximated by straight pieces."""

    def __init__(self, cable: Cable) -> None:
        catenary = cable.catenary()
        points = catenary.sample(catenary.pieces(MAX_ERROR) + 1)
        self._start, chord = points[:-1], np.diff(points, axis=0)
        self._length = np.linalg.norm(chord, axis=1)
        self._direction = chord / self._length[:, None]
        self.radius = cable.radius

    def nearest(self, p_W: np.ndarray) -> Nearest:
        """Return the nearest point of the axis to `p_W` (3,) [m]."""
        along = np.clip(((p_W - self._start) * self._direction).sum(axis=1), 0.0, self._length)
        points = self._start + along[:, None] * self._direction
        distances = np.linalg.norm(points - p_W, axis=1)
        k = int(np.argmin(distances))
        return Nearest(points[k], self._direction[k], float(distances[k]))

    def enters(self, p_WB: np.ndarray, R_WB: np.ndarray, radii: np.ndarray) -> bool:
        """Return whether the cable enters the ellipsoid of the body, inflated by the wire's radius."""
        scale = radii + self.radius
        a = (self._start - p_WB) @ R_WB / scale
        d = (self._direction * self._length[:, None]) @ R_WB / scale
        s = np.clip(-(a * d).sum(axis=1) / (d * d).sum(axis=1), 0.0, 1.0)
        return bool((((a + s[:, None] * d) ** 2).sum(axis=1) < 1.0).any())


def grip_refusal(distance: float, tilt: float, speed: float, grip: Grip) -> str:
    """Return why the gripper does not hold, one clause per violated limit; empty if it holds. [m], [rad], [m/s]"""
    problems = [
        (distance > grip.position, f"the cable passed at {distance:.3f} m, beyond {grip.position:g} m"),
        (math.degrees(tilt) > grip.tilt_deg, f"{math.degrees(tilt):.1f} deg from square, above {grip.tilt_deg:g} deg"),
        (speed > grip.speed, f"speed {speed:.2f} is above {grip.speed:g} m/s"),
        (not grip.enabled, "the grip is switched off in the scenario"),
    ]
    return "; ".join(text for missed, text in problems if missed)


class CableMonitor:
    """Monitors the cables near a vehicle. Owns the hold of the gripper; a cable in the rotors is a crash."""

    def __init__(self, cables: tuple[Cable, ...], grip: Grip, gripper_offset: float, radii: np.ndarray) -> None:
        """
        Args:
            cables: cables of the world.
            grip: tolerances of the gripper.
            gripper_offset: distance of the gripper below the centre of mass [m].
            radii: semi-axes of the ellipsoid that contains the body and its rotors, (3,) [m].
        """
        self._lines = [CableLine(cable) for cable in cables]
        self._grip, self._offset, self._radii = grip, gripper_offset, np.array(radii, float)
        self._reach = float(self._radii.max())
        self._nearest: list[Contact | None] = [None] * len(cables)  # of this pass
        self._attachment: Attachment | None = None
        self._open = False  # released, and the cable is still within reach
        self.hold: Hold = FREE
        self.crashed = False

    def release(self) -> None:
        """Open the gripper; it can close again after all cables were out of reach."""
        self._open = self._open or self._attachment is not None
        self._attachment, self.hold = None, FREE

    def update(self, time: float, x: np.ndarray) -> list[Contact]:
        """Return the contact events since the last call, one control period ago; the caller stamps them.

        Args:
            time: time since the start of the flight [s].
            x: state (13,).
        """
        if self._attachment is not None:
            self.hold = self._attachment.hold(time)
        if self._attachment is not None or self.crashed or not self._lines:
            return []
        R_WB = so3.quat_to_matrix(x[3:7])
        gripper_W = x[:3] - self._offset * R_WB[:, 2]
        events, nearest = [], [line.nearest(gripper_W) for line in self._lines]
        self._open = self._open and min(near.distance for near in nearest) <= self._offset + self._reach
        for k, (line, near) in enumerate(zip(self._lines, nearest)):
            if self._open:
                pass
            elif near.distance <= self._grip.position + LEAVING:
                events += self._within_reach(time, k, x, R_WB, gripper_W, near)
            else:
                events += self._missed(k)
            if self._attachment is not None:
                break
            # No point of the ellipsoid is further from the gripper than its greatest radius and the gripper's offset.
            close = near.distance < self._offset + self._reach + line.radius
            if not self.crashed and close and line.enters(x[:3], R_WB, self._radii):
                self.crashed = True
                events += self._missed(k)
                events.append(self._event(ContactState.COLLISION, k, x, R_WB, near, "crashed: a cable in the rotors"))
        return events

    def _missed(self, k: int) -> list[Contact]:
        """End the pass of a cable, and return its event, if there is one."""
        event, self._nearest[k] = self._nearest[k], None
        return [] if event is None else [event]

    def _within_reach(self, time: float, k: int, x: np.ndarray, R_WB: np.ndarray, gripper_W: np.ndarray,
                      near: Nearest) -> list[Contact]:
        """Grip the cable, or record the refusal at the smallest distance."""
        event = self._event(ContactState.BOUNCED, k, x, R_WB, near, "")
        speed = math.hypot(event.normal_speed, event.tangential_speed)
        refusal = grip_refusal(near.distance, event.tilt_error, speed, self._grip)
        if not refusal and (near.distance < TOUCH or event.normal_speed <= 0.0):
            square = R_WB[:, 2] - (R_WB[:, 2] @ near.direction) * near.direction
            self._attachment = Attachment(time, -1, gripper_W, near.point_W, x[3:7], square / np.linalg.norm(square), np.zeros(3))
            self.hold, self._nearest[k] = self._attachment.hold(time), None
            return [event._replace(state=ContactState.ATTACHED)]
        previous = self._nearest[k]
        if refusal and (previous is None or near.distance < previous.offset):
            self._nearest[k] = event._replace(reason=refusal)
        return []

    def _event(self, state: ContactState, k: int, x: np.ndarray, R_WB: np.ndarray, near: Nearest,
               reason: str) -> Contact:
        velocity = x[7:10] + R_WB @ np.cross(x[10:13], [0.0, 0.0, -self._offset])
        into = float(-velocity @ R_WB[:, 2])  # the gripper meets the cable along -b3
        across = float(np.linalg.norm(velocity + into * R_WB[:, 2]))
        tilt = abs(float(so3.angle_between(R_WB[:, 2], near.direction)) - math.pi / 2)
        return Contact(0, state, f"cable {k}", into, across, tilt, near.distance, reason)
