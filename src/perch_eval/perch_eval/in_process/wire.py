"""What a state looks like after its way through `nav_msgs/Odometry`: the velocity is turned into B and back.

That rounds in the last bit. It is done here with the nodes' own rotation, so that a flight in process is the same
as on the stack to the last bit, images and their tracking included.
"""

from __future__ import annotations

import numpy as np

from perch_core.ros.conversions import turned


def received_velocity(q_WB: np.ndarray, v_WB: np.ndarray) -> np.ndarray:
    """The velocity in W as a receiver reads it [m/s], shape (3,), for an attitude xyzw (4,)."""
    q = q_WB.tolist()
    return np.array(turned(q, turned(q, v_WB.tolist(), -1.0), 1.0))
