"""A hand-held camera over a photographed floor: images by OpenCV, motion by SciPy, IMU by a data sheet. See README.md."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation

START = 1_700_000_000_123_456_789                # stamp of the beginning [ns]
WIDTH, HEIGHT = 512, 384
K = np.array([[300.0, 0.0, 258.0], [0.0, 301.0, 189.0], [0.0, 0.0, 1.0]])
DISTORTION = np.array([-0.28, 0.07, 2e-4, -1e-4])
STAMP_OFFSET = 0.005                             # images are stamped late by this [s]
IMAGE_RATE, IMU_RATE = 20.0, 200.0
GYRO_DENSITY, ACCEL_DENSITY = 1.745e-4, 2.94e-3  # MPU-9250
GYRO_BIAS, ACCEL_BIAS = np.array([0.012, -0.02, 0.015]), np.array([0.08, -0.05, 0.1])
R_BC = Rotation.from_euler("z", 90.0, degrees=True) * Rotation.from_rotvec([0.02, -0.01, 0.0])  # B: forward, right, down
P_BC = np.array([0.03, -0.01, 0.02])
GRAVITY = 9.81
RESOLUTION, REACH = 0.0025, 2.4                  # of the floor, and its half side [m]
PAD = np.array([0.15, 0.05])                     # centre of the pad in x and y [m]
REST = 1.5                                       # at the beginning [s]


@dataclass(frozen=True)
class PhotoFlight:
    """What the sensors say, and the truth.

    Attributes:
        imu_stamps: [ns], shape (n,).
        imu: angular rate [rad/s] and specific force [m/s^2] in B, shape (n, 6).
        image_stamps: [ns], shape (m,).
        images: uint8 (m, HEIGHT, WIDTH).
        p_WB, q_WB: truth at the IMU's stamps, [m] and xyzw.
    """

    imu_stamps: np.ndarray
    imu: np.ndarray
    image_stamps: np.ndarray
    images: np.ndarray
    p_WB: np.ndarray
    q_WB: np.ndarray


class Motion:
    """Rest, then a wavering path of some 0.5 m/s about 0.8 m above the floor."""

    def __init__(self, duration: float) -> None:
        t = np.arange(0.0, duration + 0.5, 0.02)
        share = np.clip((t - REST) / 1.5, 0.0, 1.0)
        ramp = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        s = t - REST
        p = np.stack([0.45 * np.sin(1.1 * s), 0.35 * np.sin(1.7 * s + 0.4) - 0.35 * np.sin(0.4), 0.2 * np.sin(0.9 * s)], axis=1)
        turn = np.stack([0.18 * np.sin(1.3 * s), 0.15 * np.sin(1.9 * s), 0.3 * np.sin(2.5 * s)], axis=1)
        self._p = make_interp_spline(t, [0.0, 0.0, 0.8] + ramp[:, None] * p, k=5)
        self._turn = make_interp_spline(t, ramp[:, None] * turn, k=5)

    def pose(self, t: np.ndarray) -> tuple[np.ndarray, Rotation]:
        """p_WB (n, 3) [m] and R_WB."""
        return self._p(t), Rotation.from_rotvec(self._turn(t)) * Rotation.from_euler("x", 180.0, degrees=True)

    def felt(self, t: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Angular rate [rad/s] and specific force [m/s^2] in B, both (n, 3)."""
        h = 1e-4
        rate = (self.pose(t - 0.5 * h)[1].inv() * self.pose(t + 0.5 * h)[1]).as_rotvec() / h
        return rate, self.pose(t)[1].inv().apply(self._p(t, 2) + [0.0, 0.0, GRAVITY])


def floor() -> np.ndarray:
    """The floor: gravel, mirrored to all sides, and the pad with tags 0 to 3 as `config/boards/pad_four_tags.yaml` has them."""
    side = round(2.0 * REACH / RESOLUTION) + 1
    gravel = cv2.imread(str(Path(__file__).with_name("gravel.jpg")), cv2.IMREAD_GRAYSCALE)
    two = np.block([[gravel, gravel[:, ::-1]], [gravel[::-1], gravel[::-1, ::-1]]])
    out = np.tile(two, (3, 3))[:side, :side].copy()
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)

    def place(centre: np.ndarray, size: float, picture: np.ndarray) -> None:
        corners = PAD + centre + 0.5 * size * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])  # TL, TR, BR, BL
        n = picture.shape[0]
        source = np.array([[-0.5, -0.5], [n - 0.5, -0.5], [n - 0.5, n - 0.5], [-0.5, n - 0.5]])
        H = cv2.getPerspectiveTransform(source.astype(np.float32), _pixels(corners).astype(np.float32))
        warped = cv2.warpPerspective(picture, H, (side, side), flags=cv2.INTER_NEAREST)
        mask = cv2.warpPerspective(np.full_like(picture, 255), H, (side, side), flags=cv2.INTER_NEAREST)
        out[mask > 0] = warped[mask > 0]

    place(np.zeros(2), 0.6, np.full((8, 8), 235, np.uint8))
    for number, centre in enumerate(((0.2, 0.2), (0.2, -0.2), (-0.2, -0.2), (-0.2, 0.2))):
        marker = cv2.aruco.generateImageMarker(dictionary, number, 256)
        place(np.array(centre), 0.16, np.where(marker > 0, 235, 25).astype(np.uint8))
    return cv2.GaussianBlur(out, (0, 0), 0.6)


def _pixels(points: np.ndarray) -> np.ndarray:
    """Columns and rows of the floor's picture of points (n, 2) in x and y: y goes up in it."""
    return np.stack([points[:, 0] + REACH, REACH - points[:, 1]], axis=1) / RESOLUTION


def make(duration: float = 9.0, seed: int = 1) -> PhotoFlight:
    """The recording of a flight of a duration [s]."""
    rng, motion, ground = np.random.default_rng(seed), Motion(duration), floor()
    t = np.arange(0.0, duration, 1.0 / IMU_RATE)
    rate, force = motion.felt(t)
    noise = rng.standard_normal((len(t), 6)) * np.repeat([GYRO_DENSITY, ACCEL_DENSITY], 3) * np.sqrt(IMU_RATE)
    imu = np.hstack([rate + GYRO_BIAS, force + ACCEL_BIAS]) + noise
    p, R = motion.pose(t)
    grid = np.stack(np.meshgrid(np.arange(WIDTH, dtype=np.float64), np.arange(HEIGHT, dtype=np.float64)), axis=-1).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 50, 1e-9)
    plane = cv2.undistortPoints(grid, K, DISTORTION, criteria=criteria).reshape(-1, 2)
    rays = np.column_stack([plane, np.ones(len(plane))])
    times, images = np.arange(0.02, duration - 0.02, 1.0 / IMAGE_RATE), []
    for middle in times:
        p_WB, R_WB = motion.pose(middle)
        R_CW, p_WC = (R_WB * R_BC).inv().as_matrix(), p_WB + R_WB.apply(P_BC)
        H = np.linalg.inv(np.column_stack([R_CW[:, 0], R_CW[:, 1], -R_CW @ p_WC]))  # of the plane z = 0: camera to floor
        on_floor = rays @ H.T
        where = _pixels(on_floor[:, :2] / on_floor[:, 2:]).astype(np.float32).reshape(HEIGHT, WIDTH, 2)
        image = cv2.remap(ground, where, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)
        images.append(np.clip(image + 2.0 * rng.standard_normal(image.shape), 0, 255).astype(np.uint8))
    stamps = START + np.round(1e9 * t).astype(np.int64)
    return PhotoFlight(stamps, imu, START + np.round(1e9 * (times + STAMP_OFFSET)).astype(np.int64), np.array(images), p, R.as_quat())


# -- files -----------------------------------------------------------------------------------------------------------


def kalibr(folder: Path) -> tuple[Path, Path]:
    """`camchain-imucam.yaml` and `imu.yaml` as Kalibr writes them."""
    T_CI = np.eye(4)
    T_CI[:3, :3] = R_BC.inv().as_matrix()
    T_CI[:3, 3] = -R_BC.inv().apply(P_BC)
    rows = "\n".join(f"  - [{', '.join(f'{x:.15f}' for x in row)}]" for row in T_CI)
    chain, imu = folder / "camchain-imucam.yaml", folder / "imu.yaml"
    chain.write_text(
        f"cam0:\n  T_cam_imu:\n{rows}\n  cam_overlaps: []\n  camera_model: pinhole\n  distortion_coeffs: {DISTORTION.tolist()}\n"
        f"  distortion_model: radtan\n  intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}]\n  resolution: [{WIDTH}, {HEIGHT}]\n"
        f"  rostopic: /cam0/image_raw\n  timeshift_cam_imu: {-STAMP_OFFSET}\n")
    imu.write_text(
        f"rostopic: /imu0\nupdate_rate: {IMU_RATE}\naccelerometer_noise_density: {ACCEL_DENSITY}\naccelerometer_random_walk: 1.0e-03\n"
        f"gyroscope_noise_density: {GYRO_DENSITY}\ngyroscope_random_walk: 1.0e-05\n")
    return chain, imu


def write_asl(flight: PhotoFlight, folder: Path, calibrated: bool = True) -> Path:
    """An EuRoC folder; its `sensor.yaml` has no place for the time offset, so the images are stamped without it where calibrated."""
    cam, imu, truth = (folder / "mav0" / name for name in ("cam0", "imu0", "state_groundtruth_estimate0"))
    for path in (cam / "data", imu, truth):
        path.mkdir(parents=True)
    late = round(1e9 * STAMP_OFFSET) if calibrated else 0
    lines = ["#timestamp [ns],filename"]
    for stamp, image in zip((flight.image_stamps - late).tolist(), flight.images):
        cv2.imwrite(str(cam / "data" / f"{stamp}.png"), image, [cv2.IMWRITE_PNG_COMPRESSION, 1])
        lines.append(f"{stamp},{stamp}.png")
    (cam / "data.csv").write_text("\r\n".join(lines) + "\r\n")
    _csv(imu / "data.csv", flight.imu_stamps, flight.imu)
    _csv(truth / "data.csv", flight.imu_stamps, np.hstack([flight.p_WB, flight.q_WB[:, [3, 0, 1, 2]]]))
    if calibrated:
        T_BC = np.eye(4)
        T_BC[:3, :3], T_BC[:3, 3] = R_BC.as_matrix(), P_BC
        (cam / "sensor.yaml").write_text(
            f"sensor_type: camera\n{_opencv('T_BS', T_BC)}rate_hz: {IMAGE_RATE:g}\nresolution: [{WIDTH}, {HEIGHT}]\ncamera_model: pinhole\n"
            f"intrinsics: [{K[0, 0]}, {K[1, 1]}, {K[0, 2]}, {K[1, 2]}] #fu, fv, cu, cv\ndistortion_model: radial-tangential\n"
            f"distortion_coefficients: {DISTORTION.tolist()}\n")
        (imu / "sensor.yaml").write_text(
            f"%YAML:1.0\nsensor_type: imu\n{_opencv('T_BS', np.eye(4))}rate_hz: {IMU_RATE:g}\ngyroscope_noise_density: {GYRO_DENSITY}\n"
            f"gyroscope_random_walk: 1.0e-05\naccelerometer_noise_density: {ACCEL_DENSITY}\naccelerometer_random_walk: 1.0e-03\n")
    return folder


def write_bag(flight: PhotoFlight, path: Path, plugin: str, compressed: bool = False) -> Path:
    """A rosbag2 folder, `plugin` SQLITE3 or MCAP, with what Kalibr's files name, and the truth on /truth."""
    from rosbags.rosbag2 import StoragePlugin, Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    kinds = store.types

    def head(stamp: int, frame: str):
        return kinds["std_msgs/msg/Header"](kinds["builtin_interfaces/msg/Time"](stamp // 10**9, stamp % 10**9), frame)

    def vector(v, name: str = "Vector3"):
        return kinds[f"geometry_msgs/msg/{name}"](*(float(x) for x in v))

    kind = "sensor_msgs/msg/CompressedImage" if compressed else "sensor_msgs/msg/Image"
    nothing, rows = np.zeros(9), []
    for stamp, row in zip(flight.imu_stamps.tolist(), flight.imu):
        rows.append((stamp + 1_000_000, "/imu0", kinds["sensor_msgs/msg/Imu"](
            head(stamp, "imu4"), vector((0, 0, 0, 1), "Quaternion"), nothing, vector(row[:3]), nothing, vector(row[3:]), nothing)))
    for stamp, image in zip(flight.image_stamps.tolist(), flight.images):
        header = head(stamp, "cam0")
        message = (kinds[kind](header, "png", cv2.imencode(".png", image)[1].ravel()) if compressed else
                   kinds[kind](header, HEIGHT, WIDTH, "mono8", 0, WIDTH, image.ravel()))
        rows.append((stamp + 30_000_000, "/cam0/image_raw/compressed" if compressed else "/cam0/image_raw", message))
    for stamp, p, q in zip(flight.imu_stamps.tolist(), flight.p_WB, flight.q_WB):
        pose = kinds["geometry_msgs/msg/Pose"](vector(p, "Point"), vector(q, "Quaternion"))
        rows.append((stamp, "/truth", kinds["geometry_msgs/msg/PoseStamped"](head(stamp, "map"), pose)))
    with Writer(path, version=9, storage_plugin=StoragePlugin[plugin]) as writer:
        connections = {}
        for arrived, topic, message in sorted(rows, key=lambda row: row[0]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, message.__msgtype__, typestore=store)
            writer.write(connections[topic], arrived, store.serialize_cdr(message, message.__msgtype__))
    return path


def _csv(path: Path, stamps: np.ndarray, values: np.ndarray) -> None:
    rows = (f"{stamp},{','.join(f'{x:.12g}' for x in row)}\n" for stamp, row in zip(stamps.tolist(), values.tolist()))
    path.write_text("#timestamp [ns],...\n" + "".join(rows))


def _opencv(key: str, T: np.ndarray) -> str:
    return f"{key}:\n  cols: 4\n  rows: 4\n  data: [{', '.join(f'{x:.15f}' for x in T.ravel())}]\n"
