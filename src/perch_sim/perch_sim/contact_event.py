"""States of a contact, as they are reported."""

from __future__ import annotations

from enum import IntEnum


class ContactState(IntEnum):
    """The constants of perch_msgs/Contact."""

    NONE = 0
    ATTACHED = 1
    BOUNCED = 2
    COLLISION = 3
    GROUND = 4
