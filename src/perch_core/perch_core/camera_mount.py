"""Mounting and timing of a camera on the vehicle."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from perch_core.arrays import Array
from perch_core.camera import Camera
from perch_core.errors import ConfigError


@dataclass(frozen=True)
class CameraMount:
    """A camera on the vehicle with its pose and its timing.

    An image carries the camera board's stamp; the middle of its exposure on the IMU's clock is stamp - stamp_offset.
    The image leaves the sensor `readout` after the end of the exposure, and arrives after a further transport
    delay drawn from [transport_min, transport_max].

    Attributes:
        name: `down` or `front`; names the topics `camera_<name>/...`.
        camera: the projection.
        p_BC: optical centre in B [m], shape (3,).
        R_BC: attitude of C in B, shape (3, 3).
        rate: frames per second [Hz].
        exposure: exposure time [s].
        exposure_max: longest exposure that the driver's automatic exposure sets [s].
        readout: time to read the frame out [s].
        transport_min, transport_max: range of the transport delay [s].
        stamp_offset: stamp minus the time of the middle of the exposure on the IMU's clock [s].
        colour: whether the sensor delivers rgb8 instead of mono8.
    """

    name: str
    camera: Camera
    p_BC: Array
    R_BC: Array
    rate: float = 30.0
    exposure: float = 3.5e-3
    exposure_max: float = 9.7e-3
    readout: float = 9.3e-3
    transport_min: float = 5e-3
    transport_max: float = 10e-3
    stamp_offset: float = -8e-3
    colour: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "p_BC", np.array(self.p_BC, dtype=float).reshape(3))
        object.__setattr__(self, "R_BC", np.array(self.R_BC, dtype=float).reshape(3, 3))
        if not np.allclose(self.R_BC @ self.R_BC.T, np.eye(3), atol=1e-6) or np.linalg.det(self.R_BC) < 0:
            raise ConfigError("CameraMount", "R_BC", f"{self.R_BC.tolist()} is not a rotation")
        if not self.rate > 0:
            raise ConfigError("CameraMount", "rate", f"{self.rate!r} is not > 0 Hz")
        if not 0 <= self.exposure <= self.exposure_max:
            raise ConfigError("CameraMount", "exposure", f"{self.exposure!r} is outside [0, {self.exposure_max}] s")
        if not 0 <= self.transport_min <= self.transport_max:
            raise ConfigError("CameraMount", "transport_min",
                              f"{self.transport_min!r} is outside [0, {self.transport_max}] s")

    def pose(self, p_WB: Array, R_WB: Array) -> tuple[Array, np.ndarray]:
        """Pose of the camera in W: p_WC (..., 3) [m] and R_WC (..., 3, 3), from the body's."""
        return p_WB + (R_WB @ self.p_BC), R_WB @ self.R_BC
