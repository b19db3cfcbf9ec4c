"""Every change of axes on the way to and from an autopilot against scipy: MAVLink's messages, Betaflight's sticks and packets.

`pymavlink` is not needed: a stand-in notes what its encoders are given. The order of their arguments is tested in
test_autopilot_mavlink.py, Betaflight's own answers in test_autopilot_firmware.py.
"""

from __future__ import annotations

import socket
import sys
from itertools import count
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from perch_autopilot import frames, msp, sitl
from perch_autopilot.configuration import load_configuration
from perch_autopilot.mavlink import Mavlink, MavlinkParameters
from perch_autopilot.rates import Sticks, rate_curves
from perch_core.values import NANOSECONDS, OdometryState, RatesThrust
from perch_core.vehicle import load_vehicle
from scipy.spatial.transform import Rotation

NED = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])  # of ENU
FRD = Rotation.from_euler("x", 180.0, degrees=True)             # of FLU; of W with x to the north as well
VECTORS = st.lists(st.floats(-8, 8), min_size=3, max_size=3).map(np.array)
ROTATIONS = st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 1e-3).map(Rotation.from_quat)
SPREADS = st.lists(st.floats(-2, 2), min_size=36, max_size=36).map(lambda x: np.reshape(x, (6, 6))).map(lambda A: A @ A.T)


def same(q_xyzw, R: Rotation) -> bool:
    return (Rotation.from_quat(q_xyzw) * R.inv()).magnitude() < 1e-6


class Encoders:
    """In the place of pymavlink's: a message is its name and what it was made of."""

    def __init__(self, *_, **__) -> None:
        self.seq, self.sent = 0, {}

    def __getattr__(self, name: str):
        if not name.endswith("_encode"):
            raise AttributeError(name)

        def encode(*values):
            self.sent[name.removesuffix("_encode")] = values
            return SimpleNamespace(pack=lambda _: b"\0")

        return encode

    def parse_buffer(self, data: bytes) -> list:
        """PX4's heartbeat."""
        return [SimpleNamespace(get_type=lambda: "HEARTBEAT", get_srcSystem=lambda: 1, get_srcComponent=lambda: 1, type=2, autopilot=12,
                                base_mode=0, custom_mode=0, system_status=4)]


@pytest.fixture(scope="module")
def node():
    """The node `mavlink`, on a link at whose other end somebody is."""
    names = ["pymavlink", "pymavlink.dialects", "pymavlink.dialects.v20"]
    before = {name: sys.modules.get(name) for name in names}
    modules = {name: ModuleType(name) for name in names}
    modules[names[-1]].common = SimpleNamespace(MAVLink=Encoders)
    sys.modules.update(modules)
    ours, theirs = socket.socketpair()
    theirs.send(b"\0")  # what the stand-in takes for a heartbeat
    try:
        one = Mavlink(MavlinkParameters(link=f"fd:{ours.detach()}"))
    finally:
        for name in names:
            sys.modules.pop(name) if before[name] is None else sys.modules.update({name: before[name]})
    one.on_poll(NANOSECONDS)
    one.on_rates_thrust(RatesThrust(0, False, (0.0, 0.0, 0.0), 0.0))
    yield one
    one.close()
    theirs.close()


STAMPS = count(NANOSECONDS, NANOSECONDS // 50)  # as often as odometry goes out


@given(p=VECTORS, R=ROTATIONS, v=VECTORS, w=VECTORS, P=SPREADS, Q=SPREADS)
@settings(max_examples=50, deadline=None)
def test_odometry_goes_out_as_frd_in_local_frd(node, p, R, v, w, P, Q):
    node.on_odometry(OdometryState(next(STAMPS), tuple(p), tuple(R.as_quat()), tuple(v), tuple(w), P, Q))
    _, frame, child, *place, q, vx, vy, vz, rx, ry, rz, pose, twist = node._mavlink.sent["odometry"]
    assert (frame, child) == (20, 12)                                                  # MAV_FRAME_LOCAL_FRD, MAV_FRAME_BODY_FRD
    assert place == pytest.approx(NED.apply(p)) and same((*q[1:], q[0]), NED * R * FRD.inv())  # wxyz
    assert (vx, vy, vz) == pytest.approx(FRD.apply(v), abs=1e-9) and (rx, ry, rz) == pytest.approx(FRD.apply(w), abs=1e-9)
    for sent, axes, covariance in ((pose, NED, P), (twist, FRD, Q)):
        both = np.zeros((6, 6))
        both[:3, :3] = both[3:, 3:] = axes.as_matrix()
        upper = [float((both @ covariance @ both.T)[i, j]) for i in range(6) for j in range(i, 6)]
        assert sent == pytest.approx(upper, abs=1e-9)


@given(w=VECTORS, thrust=st.floats(0.0, 30.0))
@settings(max_examples=50, deadline=None)
def test_rates_go_out_as_frd(node, w, thrust):
    node.on_rates_thrust(RatesThrust(0, True, tuple(w), thrust))
    node.on_poll(NANOSECONDS)
    *_, q, p_F, q_F, r_F, share = node._mavlink.sent["set_attitude_target"]
    vehicle = load_vehicle("snapdragon_rates")
    assert (p_F, q_F, r_F) == pytest.approx(FRD.apply(w), abs=1e-9)
    assert share == pytest.approx(min(thrust * vehicle.mass / (4.0 * vehicle.thrust_max), 1.0))


@given(f=VECTORS, w=VECTORS)
@settings(max_examples=50, deadline=None)
def test_samples_come_in_as_flu(node, f, w):
    node._clock.offset, got = 0, []
    node.imu.receivers[:] = [got.append]
    node._handle_message(SimpleNamespace(get_type=lambda: "HIGHRES_IMU", get_srcSystem=lambda: 1, time_usec=1000, xacc=f[0], yacc=f[1], zacc=f[2],
                               xgyro=w[0], ygyro=w[1], zgyro=w[2]), NANOSECONDS)
    sample, = got
    assert sample.f_B == pytest.approx(FRD.inv().apply(f), abs=1e-9) and sample.w_B == pytest.approx(FRD.inv().apply(w), abs=1e-9)


def test_an_attitude_has_the_euler_angles_of_aviation():
    """Roll to the right, nose up, heading from north; of a body with the heading east, then turned in its own axes."""
    for roll, pitch, heading in np.random.default_rng(1).uniform(-80, 80, (50, 3)):
        # FLU, ENU: rolling to the right is +x, nose up is -y, and a heading from north is 90 deg less the turn about z.
        R = Rotation.from_euler("ZYX", (90.0 - heading, -pitch, roll), degrees=True)
        told = Rotation.from_quat(frames.attitude(R.as_quat())).as_euler("ZYX", degrees=True)
        assert told == pytest.approx((heading, pitch, roll), abs=1e-6)


STICKS = Sticks(load_vehicle("betaflight"), CURVES := rate_curves(load_configuration("betaflight").settings, ""))


@given(VECTORS)
def test_sticks_ask_for_the_rates_in_betaflights_axes(w):
    """Stick to the right: +roll of FRD; stick forward: the nose sinks, -pitch of FRD; yaw to the right: +yaw of FRD."""
    roll, pitch, _, yaw = STICKS.channels(tuple(w), 9.81)
    asked = [np.radians(curve.rate((pulse - 1500) / 500)) for curve, pulse in zip(CURVES, (roll, pitch, yaw))]
    most = [np.radians(curve.rate(1.0)) for curve in CURVES]
    assert asked == pytest.approx(np.clip(FRD.apply(w) * (1.0, -1.0, 1.0), np.negative(most), most), abs=0.03)  # a pulse is whole [us]


@given(w=VECTORS, f=VECTORS, R=ROTATIONS)
@settings(max_examples=50, deadline=None)
def test_packets_of_the_simulated_sensors(w, f, R):
    """Rates in FRD, specific force in -FLU, attitude of FRD in the world turned about its x; wxyz."""
    sent: dict = {}
    loop = sitl.Sitl.__new__(sitl.Sitl)
    loop.time, loop._running = 0.0, SimpleNamespace(
        sent=SimpleNamespace(sendto=lambda data, to: sent.update({to[1]: data})), received=SimpleNamespace(recv=lambda _: bytes(16)))
    x, y, z, s = R.as_quat()
    loop.step(tuple(w), tuple(f), (s, x, y, z), (1500,) * 4)
    _, *values = sitl._STATE.unpack(sent[sitl.STATE])
    assert values[:3] == pytest.approx(FRD.apply(w), abs=1e-9) and values[3:6] == pytest.approx(-f)
    assert same((*values[7:10], values[6]), FRD * R * FRD.inv())


@given(f=st.lists(st.integers(-9999, 9999), min_size=3, max_size=3), w=st.lists(st.integers(-9999, 9999), min_size=3, max_size=3))
def test_raw_samples_are_flu_as_they_come(f, w):
    payload = b"".join(int(value).to_bytes(2, "little", signed=True) for value in (*f, *w))
    force, rate = msp.inertial(msp.Frame(msp.RAW_IMU, payload, False), 2048.0)
    assert force == pytest.approx(np.multiply(f, 9.81 / 2048.0)) and np.degrees(rate) == pytest.approx(np.divide(w, 16.4))
