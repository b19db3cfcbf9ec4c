"""Rules of contact: adhesion of the velcro, bounce, landing, collision and crash.

Forces are computed in `dynamics`; this module classifies touches. The limits of adhesion are properties of the material
and are taken from the scenario.
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
from perch_sim.obstacles import Obstacles
from perch_sim.scenario import Adhesion

SEPARATION = 0.05      # a touch is over when nothing has touched for so long [s]
CRASH_SPEED = 2.0      # rotors and frame do not survive a faster impact [m/s]
LANDING_TILT = math.radians(45.0)  # steeper on the floor is no landing


class Impact(NamedTuple):
    """Motion of the plate relative to a surface as they meet."""

    normal_speed: float      # into the surface [m/s]
    tangential_speed: float  # [m/s]
    tilt_error: float        # between b3 and s3 [rad]
    offset_S: np.ndarray     # plate's centre from the surface's origin along s1, s2, s3, (3,) [m]


def impact_of(x: np.ndarray, plate_offset: float, p_WS: np.ndarray, R_WS: np.ndarray, v_WS: np.ndarray) -> Impact:
    """Return the impact of the plate's centre on a surface.

    Args:
        x: state (13,).
        plate_offset: distance of the plate below the centre of mass [m].
        p_WS, R_WS, v_WS: origin [m], axes and velocity [m/s] of the surface.
    """
    R_WB = so3.quat_to_matrix(x[3:7])
    arm_B = np.array([0.0, 0.0, -plate_offset])
    velocity_S = R_WS.T @ (x[7:10] + R_WB @ np.cross(x[10:13], arm_B) - v_WS)
    return Impact(float(-velocity_S[2]), float(np.hypot(velocity_S[0], velocity_S[1])),
                  float(so3.angle_between(R_WB[:, 2], R_WS[:, 2])), R_WS.T @ (x[:3] + R_WB @ arm_B - p_WS))


def adhesion_refusal(impact: Impact, adhesion: Adhesion, pad_half: np.ndarray) -> str:
    """Return why the velcro does not hold, one clause per violated limit; empty if it holds."""
    low, high = adhesion.normal_speed
    beside = float(np.max(np.abs(impact.offset_S[:2]) - pad_half))
    tilt = math.degrees(impact.tilt_error)
    problems = [
        (beside > 0.0, f"touched {beside:.3f} m outside the pad"),
        (not low <= impact.normal_speed <= high,
         f"normal speed {impact.normal_speed:.2f} is outside [{low:g}, {high:g}] m/s"),
        (impact.tangential_speed > adhesion.tangential_speed_max,
         f"tangential speed {impact.tangential_speed:.2f} is above {adhesion.tangential_speed_max:g} m/s"),
        (tilt > adhesion.tilt_error_max_deg, f"tilt error {tilt:.1f} is above {adhesion.tilt_error_max_deg:g} deg"),
        (not adhesion.enabled, "adhesion is switched off in the scenario"),
    ]
    return "; ".join(text for missed, text in problems if missed)


class ContactMonitor:
    """Tracks and classifies touches over time. Owns the hold of the velcro and the crash state."""

    def __init__(self, plate_offset: float, obstacles: Obstacles, adhesion: Adhesion) -> None:
        self._plate_offset, self._obstacles, self._adhesion = plate_offset, obstacles, adhesion
        self._touched: dict[int, tuple[float, ContactState]] = {}  # surface -> last touch, its state
        self._attachment: Attachment | None = None
        self.hold: Hold = FREE
        self.crashed = False

    @property
    def attached(self) -> bool:
        """Whether the velcro holds."""
        return self._attachment is not None

    @property
    def free(self) -> bool:
        """Whether nothing is attached, and nothing was touched within `SEPARATION`."""
        return not (self._touched or self.attached)

    def release(self) -> None:
        """Release the velcro; a surface that is still touched can hold again only after a separation."""
        self._attachment, self.hold = None, FREE

    def update(self, time: float, before: np.ndarray, x: np.ndarray, touched: np.ndarray) -> list[Contact]:
        """Return the contact events of this instant; the caller stamps them.

        Args:
            time: time since the start of the flight [s].
            before: state one integration step earlier (13,): impacts are classified by it, before their forces act.
            x: state (13,).
            touched: clearances of each surface, from `dynamics.clearances` (m, 3); a negative distance is a touch.
        """
        events = []
        for s in range(len(touched)):
            plate, rest, speed = touched[s, 0] < 0.0, touched[s, 1] < 0.0, float(touched[s, 2])
            if self._attachment is not None and s == self._attachment.surface:
                continue
            if plate or rest:
                event = self._touch(time, s, before, x, rest, speed)
                events += [event] if event else []
        events += self._separations(time)
        if self._attachment is not None:
            self.hold = self._attachment.hold(time)
        return events

    def _touch(self, time: float, s: int, before: np.ndarray, x: np.ndarray, rest: bool, speed: float) -> Contact | None:
        previous, crashes = self._touched.get(s), speed > CRASH_SPEED and not self.crashed
        if previous is not None and not crashes and (previous[1] is ContactState.COLLISION or not rest):
            self._touched[s] = (time, previous[1])
            return None
        surfaces = self._obstacles.surfaces
        p_WS = surfaces.origin[s] + surfaces.velocity[s] * time
        impact = impact_of(before, self._plate_offset, p_WS, surfaces.axes[s], surfaces.velocity[s])
        state, reason = self._classify(s, impact, rest, speed)
        self._touched[s] = (time, state)
        if state is ContactState.ATTACHED:
            self._attach(time, s, x, p_WS)
        offset = float(np.hypot(impact.offset_S[0], impact.offset_S[1])) if s == self._obstacles.pad else 0.0
        return Contact(0, state, self._obstacles.names[s], impact.normal_speed, impact.tangential_speed,
                       impact.tilt_error, offset, reason)

    def _classify(self, s: int, impact: Impact, rest: bool, speed: float) -> tuple[ContactState, str]:
        """Classify a touch, and record a crash; `speed` is that of its fastest point into the surface [m/s]."""
        name, fast = self._obstacles.names[s], speed > CRASH_SPEED
        too_fast = f"hit the {name} with {speed:.2f} m/s, above {CRASH_SPEED:g} m/s"
        if self.crashed:
            return ContactState.COLLISION, f"touched the {name} after the crash"
        if name == "floor":
            self.crashed = rest or fast or impact.tilt_error > LANDING_TILT
            if not self.crashed:
                return ContactState.GROUND, ""
            tilt = f"touched the floor tilted by {math.degrees(impact.tilt_error):.0f} deg"
            return ContactState.COLLISION, f"crashed: {too_fast if fast else tilt}"
        self.crashed = fast
        if fast or rest or s != self._obstacles.pad:
            part = "a rotor" if rest else "the plate"
            return ContactState.COLLISION, f"crashed: {too_fast}" if fast else f"{part} touched the {name}"
        refusal = adhesion_refusal(impact, self._adhesion, self._obstacles.pad_half)
        return (ContactState.BOUNCED, refusal) if refusal else (ContactState.ATTACHED, "")

    def _separations(self, time: float) -> list[Contact]:
        over = [s for s, (last, _) in self._touched.items()
                if time - last > SEPARATION and not (self._attachment is not None and s == self._attachment.surface)]
        for s in over:
            del self._touched[s]
        if not over or self._touched:
            return []
        return [Contact(0, ContactState.NONE, self._obstacles.names[over[0]], 0.0, 0.0, 0.0, 0.0, "")]

    def _attach(self, time: float, s: int, x: np.ndarray, p_WS: np.ndarray) -> None:
        """Hold the plate where it touched; it is then pulled flat onto the surface."""
        normal = self._obstacles.surfaces.axes[s, :, 2]
        plate_W = x[:3] - self._plate_offset * so3.quat_to_matrix(x[3:7])[:, 2]
        flat_W = plate_W - ((plate_W - p_WS) @ normal) * normal
        self._attachment = Attachment(time, s, plate_W, flat_W, x[3:7], normal, self._obstacles.surfaces.velocity[s])
