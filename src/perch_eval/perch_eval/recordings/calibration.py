"""Conversion of other calibration formats to sensor files: Kalibr's camera chain and IMU, EuRoC's `sensor.yaml`."""

from __future__ import annotations

import dataclasses
import re
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from perch_core import config, so3
from perch_core.errors import ConfigError
from perch_core.sensors import Sensors
from perch_core.yaml_text import parse_yaml

MODELS = {"radtan": "radtan", "radial-tangential": "radtan", "plumb_bob": "radtan", "equidistant": "equidistant",
          "none": "pinhole", "": "pinhole"}
ROTATION_TOLERANCE = 1e-3  # of a rotation matrix in a file
UNMODELLED = {"gyroscopes.M": 1.0, "gyroscopes.C_gyro_i": 1.0, "gyroscopes.A": 0.0, "accelerometers.M": 1.0,
              "Tw": 1.0, "R_IMUtoGYRO": 1.0, "Tg": 0.0, "Ta": 1.0, "R_IMUtoACC": 1.0}
"""Scale, misalignment and g-sensitivity of an IMU, as Kalibr and OpenVINS name them: multiple of the identity of one that has none."""
IMU_KEYS = {"accel_noise_density": "accelerometer_noise_density", "gyro_noise_density": "gyroscope_noise_density",
            "accel_bias_walk": "accelerometer_random_walk", "gyro_bias_walk": "gyroscope_random_walk"}


def from_kalibr(cameras: Path, imu: Path | None, name: str, R_BI: np.ndarray = np.eye(3)) -> Sensors:
    """Convert a Kalibr calibration.

    Args:
        cameras: `camchain-imucam.yaml`: with `T_cam_imu` of every camera, or its inverse `T_imu_cam`, as OpenVINS has it.
        imu: `imu.yaml`; None: cameras only.
        name: of the sensors.
        R_BI: axes of the IMU in the body, shape (3, 3).

    Raises:
        ConfigError: a file cannot be read, is incomplete, or has an unknown camera model.
    """
    chain = _mapping(cameras)
    found = {key: value for key, value in chain.items() if re.fullmatch(r"cam\d+", key)}
    if not found:
        raise ConfigError(str(cameras), "", "has no cam0: it is no camera chain of Kalibr")
    out = {key: _kalibr_camera(str(cameras), key, value, R_BI) for key, value in found.items()}
    sensors: dict[str, Any] = {"name": name, "cameras": out}
    if imu is not None:
        content = _mapping(imu)
        sensors["imu"] = _imu(str(imu), content.get("imu0", content), R_BI)
    return config.from_mapping(Sensors, sensors, str(cameras))


def from_asl(root: Path, R_BI: np.ndarray = np.eye(3)) -> Sensors:
    """Convert the `sensor.yaml` files of a folder in the ASL format. The origin of the body is the IMU.

    Raises:
        ConfigError: a file cannot be read, is incomplete, or has an unknown camera model.
    """
    name = root.resolve().parent.name if root.name == "mav0" else root.resolve().name
    out: dict[str, Any] = {"name": re.sub(r"[^\w.+-]", "_", name) or "asl", "cameras": {}}
    imu = root / "imu0" / "sensor.yaml"
    T_BI = in_body(imu)
    if imu.is_file():
        out["imu"] = _imu(str(imu), _mapping(imu), R_BI)
    for file in sorted(root.glob("cam*/sensor.yaml")):
        c, source = _mapping(file), str(file)
        T_IC = np.linalg.inv(T_BI) @ _transform(source, "T_BS", _required(source, c, "T_BS"))
        camera = _camera(source, "", c, c.get("distortion_coefficients", []), T_IC, R_BI)
        out["cameras"][file.parent.name] = camera | {"rate": c.get("rate_hz", 20)}
    return config.from_mapping(Sensors, out, str(root))


def in_body(file: Path) -> np.ndarray:
    """Return T_BS of a `sensor.yaml`, shape (4, 4); the identity if the entry or the file is missing.

    Raises:
        ConfigError: it cannot be read, or is no rigid transform.
    """
    content = _mapping(file) if file.is_file() else {}
    return _transform(str(file), "T_BS", content.get("T_BS", np.eye(4)))


def to_yaml(sensors: Sensors, comment: str = "") -> str:
    """Return the text of a sensor file; values equal to their default are left out."""
    body = yaml.safe_dump(_plain(sensors), sort_keys=False, default_flow_style=None, width=120)
    return "".join(f"# {line}\n" for line in comment.splitlines()) + body


def _plain(value: Any) -> Any:
    """Dataclasses as mappings without their defaults, tuples as lists."""
    if dataclasses.is_dataclass(value):
        return {f.name: _plain(item) for f in dataclasses.fields(value) if (item := getattr(value, f.name)) != f.default
                and (f.default_factory is dataclasses.MISSING or item != f.default_factory())}
    if isinstance(value, dict):
        return {key: _plain(item) for key, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _kalibr_camera(source: str, key: str, c: Any, R_BI: np.ndarray) -> dict[str, Any]:
    if not isinstance(c, dict):
        raise ConfigError(source, key, "is no mapping")
    if "T_cam_imu" in c:
        T_IC = np.linalg.inv(_transform(source, f"{key}.T_cam_imu", c["T_cam_imu"]))
    elif "T_imu_cam" in c:
        T_IC = _transform(source, f"{key}.T_imu_cam", c["T_imu_cam"])
    else:
        raise ConfigError(source, f"{key}.T_cam_imu", "missing: give the result of kalibr_calibrate_imu_camera (camchain-imucam)")
    out = _camera(source, f"{key}.", c, c.get("distortion_coeffs", []), T_IC, R_BI)
    # Kalibr: t_imu = t_cam + timeshift
    shift = _number(source, f"{key}.timeshift_cam_imu", c.get("timeshift_cam_imu", 0.0))
    if abs(shift) > 0.5:
        raise ConfigError(source, f"{key}.timeshift_cam_imu", f"{shift:g} s is outside [-0.5, 0.5] s")
    return out | {"stamp_offset": -shift, "topic": str(c.get("rostopic", ""))}


def _camera(source: str, dot: str, c: dict[str, Any], distortion: Any, T_IC: np.ndarray, R_BI: np.ndarray) -> dict[str, Any]:
    """Convert the camera entries that both formats share."""
    kind = str(c.get("camera_model", "pinhole"))
    if kind != "pinhole":
        raise ConfigError(source, f"{dot}camera_model", f"{kind!r} is not pinhole (with radtan, equidistant or no distortion)")
    model = str(c.get("distortion_model", ""))
    if model not in MODELS:
        raise ConfigError(source, f"{dot}distortion_model", f"{model!r} is not one of {', '.join(filter(None, MODELS))}")
    intrinsics, resolution = (_required(source, c, key, dot) for key in ("intrinsics", "resolution"))
    for key, value, n in (("intrinsics", intrinsics, 4), ("resolution", resolution, 2)):
        if not isinstance(value, list) or len(value) != n:
            raise ConfigError(source, f"{dot}{key}", f"{value!r} is not {n} numbers")
    R_BC, p_BC = R_BI @ T_IC[:3, :3], R_BI @ T_IC[:3, 3]
    return {"model": MODELS[model], "width": resolution[0], "height": resolution[1], "focal": intrinsics[:2], "centre": intrinsics[2:],
            "distortion": distortion if MODELS[model] != "pinhole" else [], "position": p_BC.tolist(),
            "orientation": so3.quat_from_matrix(R_BC).tolist()}


def _imu(source: str, c: Any, R_BI: np.ndarray) -> dict[str, Any]:
    if not isinstance(c, dict):
        raise ConfigError(source, "", "is no mapping")
    _check_unmodelled(source, c)
    out: dict[str, Any] = {ours: _number(source, theirs, _required(source, c, theirs)) for ours, theirs in IMU_KEYS.items()}
    return out | {"rate": _number(source, "update_rate", c.get("update_rate", c.get("rate_hz"))),
                  "orientation": so3.quat_from_matrix(R_BI).tolist(), "topic": str(c.get("rostopic", ""))}


def _check_unmodelled(source: str, c: dict[str, Any]) -> None:
    """Refuse an IMU whose samples have to be corrected by a matrix: sensor files have none.

    Raises:
        ConfigError: a matrix of `UNMODELLED` is not that of an IMU without such errors.
    """
    for name, factor in UNMODELLED.items():
        value: Any = c
        for key in name.split("."):
            value = value.get(key) if isinstance(value, dict) else None
        try:
            none = value is None or np.allclose(np.array(value, float), factor * np.eye(3), atol=1e-6)
        except (TypeError, ValueError):
            none = False
        if not none:
            raise ConfigError(source, name, f"{value} is not {'the identity' if factor else 'zero'}: sensor files have no scale, misalignment or "
                              "g-sensitivity of the IMU; calibrate with --imu-models calibrated, or correct the samples")


def _mapping(path: Path) -> dict[str, Any]:
    """A YAML file, also one of OpenCV (with `%YAML:1.0` and `!!opencv-matrix`)."""
    try:
        text = path.read_text(errors="replace")
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot be read: {error.strerror}") from None
    text = re.sub(r"^%YAML.*$", "", text, count=1, flags=re.MULTILINE).replace("!!opencv-matrix", "")
    content = parse_yaml(text, str(path))
    if not isinstance(content, dict):
        raise ConfigError(str(path), "", "is no mapping")
    return content


def _required(source: str, c: dict[str, Any], key: str, dot: str = "") -> Any:
    if key not in c:
        raise ConfigError(source, f"{dot}{key}", "missing")
    return c[key]


def _number(source: str, key: str, value: Any) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ConfigError(source, key, f"{value!r} is not a number")
    return float(value)


def _transform(source: str, key: str, value: Any) -> np.ndarray:
    """Parse a rigid transform, (4, 4); its rotation is orthonormalised, as files have some ten digits."""
    try:
        T = np.array(value["data"] if isinstance(value, dict) else value, float).reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        raise ConfigError(source, key, "is not 4 x 4 numbers") from None
    R = T[:3, :3]
    rotation = np.isfinite(T).all() and np.abs(R @ R.T - np.eye(3)).max() <= ROTATION_TOLERANCE and np.linalg.det(R) >= 0.0
    if not rotation or not np.allclose(T[3], [0, 0, 0, 1]):
        raise ConfigError(source, key, f"{np.round(T, 4).tolist()} is no rigid transform")
    T[:3, :3] = so3.nearest(R)
    return T
