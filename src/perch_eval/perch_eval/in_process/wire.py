"""What a state looks like after its way through `nav_msgs/Odometry`: the velocity is turned into B and back.

That rounds in the last bit. It is done here with the nodes' own conversions, so that a flight in process is the same
as on the stack to the last bit, images and their tracking included.
"""

from __future__ import annotations

import numpy as np
from nav_msgs.msg import Odometry

from perch_core.ros.conversions import fill_odometry, odometry_arrays


class Wire:
    """One message, used again and again."""

    def __init__(self) -> None:
        self._msg = Odometry()

    def velocity(self, p_WB: np.ndarray, q_WB: np.ndarray, v_WB: np.ndarray, w_WB_B: np.ndarray) -> np.ndarray:
        """The velocity in W as a receiver reads it [m/s], shape (3,)."""
        fill_odometry(self._msg, p_WB, q_WB, v_WB, w_WB_B)
        return odometry_arrays(self._msg)[2]
