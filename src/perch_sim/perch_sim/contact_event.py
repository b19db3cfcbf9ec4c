"""What a touch is reported as."""

from __future__ import annotations

from enum import IntEnum
from typing import NamedTuple


class ContactState(IntEnum):
    """The constants of perch_msgs/Contact."""

    NONE = 0
    ATTACHED = 1
    BOUNCED = 2
    COLLISION = 3
    GROUND = 4


class ContactEvent(NamedTuple):
    """A change of what the vehicle touches; fields as in perch_msgs/Contact."""

    time: float              # [s]
    state: ContactState
    body: str
    normal_speed: float      # into the surface [m/s]
    tangential_speed: float  # [m/s]
    tilt_error: float        # between b3 and s3 [rad]
    offset: float            # from the pad's centre, in the surface [m]
    reason: str
