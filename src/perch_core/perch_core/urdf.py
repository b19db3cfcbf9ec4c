"""URDF of a vehicle file, with primitive shapes, for RViz, Foxglove and simulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from math import atan2, hypot
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

import numpy as np

from perch_core import so3
from perch_core.arrays import quaternion, vector3
from perch_core.camera_mount import CameraMount
from perch_core.static_transforms import BASE
from perch_core.vehicle import Vehicle
from perch_core.values import Transform

IMU = "imu_link"
ARM_WIDTH, ROTOR_HEIGHT, PLATE_HEIGHT = 0.012, 0.008, 0.006  # [m]
ROTOR_RADIUS = 0.1  # where the vehicle file has none [m]
COLOURS = {"body": "0.25 0.25 0.25 0.6", "arm": "0.15 0.15 0.15 1", "front": "0.9 0.2 0.2 0.8", "rear": "0.25 0.25 0.25 0.8",
           "plate": "0.1 0.5 0.2 1", "camera": "0.1 0.1 0.4 1"}


def optical_frame(camera: str) -> str:
    """Name of a camera's frame: z forward, x right, y down in the image."""
    return f"camera_{camera}_optical_frame"


def fixed_frames(vehicle: Vehicle, mounts: Mapping[str, CameraMount] | None = None) -> tuple[Transform, ...]:
    """Return the frames that are fixed to the body: IMU and cameras in `base_link`, whose origin is the centre of mass.

    `mounts`: cameras in place of the vehicle's.
    """
    imu = Transform(BASE, IMU, vehicle.imu.position, (0.0, 0.0, 0.0, 1.0))
    cameras = (Transform(BASE, optical_frame(name), vector3(mount.p_BC), quaternion(so3.quat_from_matrix(mount.R_BC)))
               for name, mount in (vehicle.mounts if mounts is None else mounts).items())
    return imu, *cameras


def urdf(vehicle: Vehicle) -> str:
    """Return the URDF of a vehicle: inertia and shapes in `base_link`, and a link for each fixed frame."""
    robot = Element("robot", name=vehicle.name)
    for name, rgba in COLOURS.items():
        SubElement(SubElement(robot, "material", name=name), "color", rgba=rgba)
    base = SubElement(robot, "link", name=BASE)
    _inertial(base, vehicle)
    _shapes(base, vehicle)
    for frame in fixed_frames(vehicle):
        link = SubElement(robot, "link", name=frame.child)
        if frame.child != IMU:
            _visual(link, frame.child, "camera", "box", (0.0, 0.0, -0.005), size=_text((0.015, 0.015, 0.01)))
        joint = SubElement(robot, "joint", name=f"{frame.child}_joint", type="fixed")
        SubElement(joint, "parent", link=frame.parent)
        SubElement(joint, "child", link=frame.child)
        SubElement(joint, "origin", xyz=_text(frame.p), rpy=_text(roll_pitch_yaw(frame.q)))
    ElementTree.indent(robot)
    return ElementTree.tostring(robot, encoding="unicode") + "\n"


def roll_pitch_yaw(q: Sequence[float]) -> tuple[float, float, float]:
    """Convert a quaternion xyzw to URDF's fixed-axis angles [rad]: R = Rz(yaw) Ry(pitch) Rx(roll)."""
    R = so3.quat_to_matrix(np.array(q))
    c = hypot(R[0, 0], R[1, 0])
    pitch = atan2(-R[2, 0], c)
    if c > 1e-6:
        return atan2(R[2, 1], R[2, 2]), pitch, atan2(R[1, 0], R[0, 0])
    return atan2(-R[1, 2], R[1, 1]), pitch, 0.0


def _inertial(link: Element, vehicle: Vehicle) -> None:
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
    SubElement(inertial, "mass", value=repr(vehicle.mass))
    J = vehicle.inertia_matrix
    SubElement(inertial, "inertia", {f"i{a}{b}": repr(float(J[i, j])) for i, a in enumerate("xyz") for j, b in enumerate("xyz") if i <= j})


def _shapes(link: Element, vehicle: Vehicle) -> None:
    """Add a box of half the body's size (full size for collisions), arms, rotors (the front ones red) and the perching plate."""
    x, y, z = vehicle.body_radii
    _visual(link, "body", "body", "box", (0.0, 0.0, 0.0), size=_text((x, y, z)))
    collision = SubElement(link, "collision", name="body")
    SubElement(collision, "origin", xyz="0 0 0", rpy="0 0 0")
    SubElement(SubElement(collision, "geometry"), "box", size=_text((2 * x, 2 * y, 2 * z)))
    radius = vehicle.propeller_radius or ROTOR_RADIUS
    for k, (rx, ry) in enumerate(vehicle.rotor_xy):
        _visual(link, f"arm_{k}", "arm", "box", (rx / 2, ry / 2, 0.0), yaw=atan2(ry, rx),
                size=_text((hypot(rx, ry), ARM_WIDTH, ARM_WIDTH)))
        _visual(link, f"rotor_{k}", "front" if rx > 0.0 else "rear", "cylinder", (rx, ry, ARM_WIDTH), radius=repr(radius),
                length=repr(ROTOR_HEIGHT))
    _visual(link, "perch_plate", "plate", "cylinder", (0.0, 0.0, PLATE_HEIGHT / 2 - vehicle.perch_offset), radius=repr(vehicle.perch_radius),
            length=repr(PLATE_HEIGHT))


def _visual(link: Element, name: str, material: str, shape: str, p: Sequence[float], yaw: float = 0.0, **size: str) -> None:
    visual = SubElement(link, "visual", name=name)
    SubElement(visual, "origin", xyz=_text(p), rpy=_text((0.0, 0.0, yaw)))
    SubElement(SubElement(visual, "geometry"), shape, size)
    SubElement(visual, "material", name=material)


def _text(numbers: Sequence[float]) -> str:
    return " ".join(repr(float(n)) for n in numbers)
