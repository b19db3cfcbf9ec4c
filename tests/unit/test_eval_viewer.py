"""Component `viewer`: a WebSocket client sees topics, images, markers and frames as Foxglove does; pages of elsewhere see nothing."""

import asyncio
import json
import re
import struct
import time

import numpy as np
import pytest
from perch_core import config
from perch_core.component import Input, ports
from perch_core.description import Description, DescriptionParameters
from perch_core.errors import ConfigError
from perch_core.ros import topics
from perch_core.trajectory import rest_to_rest
from perch_core.values import (
    AtEnd, CameraImage, ControllerStatus, MappedPowerline, Markers, OdometryState, PowerlineMap, Serialized, Shape, TargetPose, TrajectoryOrder)
from perch_core.vehicle import load_vehicle
from perch_eval.ros.definitions import message_definition
from perch_eval.view.gate import allowed
from perch_eval.view.scene import Path, map_markers, vehicle_markers, world_markers
from perch_eval.ros.viewer import CAMERAS, FAST, LOCAL, MARKERS, RARE, UNLATCHED, Viewer, ViewerParameters
from perch_msgs.msg import Trajectory
from perch_sim.scenario import load_scenario
from rclpy.serialization import deserialize_message, serialize_message
from tornado.httpclient import HTTPClientError, HTTPRequest
from tornado.websocket import websocket_connect

STEP = 2_000_000  # [ns]
P, Q = (1.0, 2.0, 1.5), (0.0, 0.0, 0.6, 0.8)
ZERO = np.zeros((6, 6))


class Client:
    """Foxglove's side of the protocol."""

    def __init__(self, loop, port, origin=None):
        self.loop = loop
        self.socket = loop.run_until_complete(self._connect(port, origin))
        self.channels, self.times, self.messages, self.closed = {}, [], {}, False
        loop.create_task(self._read())

    @staticmethod
    async def _connect(port, origin):
        request = HTTPRequest(f"ws://127.0.0.1:{port}", headers={} if origin is None else {"Origin": origin})
        return await websocket_connect(request, subprotocols=["foxglove.sdk.v1"])

    async def _read(self):
        while (message := await self.socket.read_message()) is not None:
            if isinstance(message, str):
                content = json.loads(message)
                if content["op"] == "advertise":
                    self.channels |= {c["topic"]: c for c in content["channels"]}
            elif message[0] == 1:
                subscription, stamp = struct.unpack_from("<IQ", message, 1)
                self.messages.setdefault(subscription, []).append((stamp, message[13:]))
            elif message[0] == 2:
                self.times.append(struct.unpack_from("<Q", message, 1)[0])
        self.closed = True

    def subscribe(self, topic):
        self.loop.run_until_complete(self._subscribe(self.channels[topic]["id"]))

    async def _subscribe(self, id):
        await self.socket.write_message(json.dumps({"op": "subscribe", "subscriptions": [{"id": id, "channelId": id}]}))

    def of(self, topic):
        return self.messages.get(self.channels[topic]["id"], []) if topic in self.channels else []


class Show:
    """The viewer, a client, and the test as the host."""

    def __init__(self, scenario="surface_90", origin=None, **parameters):
        self.loop = asyncio.new_event_loop()
        self.viewer = Viewer(ViewerParameters(port=0, scenario=scenario, **parameters))
        self.handlers = {port.channel(self.viewer): port.handler(self.viewer) for port in ports(type(self.viewer), Input)}
        self.drawn = []
        self.viewer.markers.receivers.append(self.drawn.append)
        self.shown, self.seen = {}, 0  # of the markers, the newest; of the messages with markers, how many are among them
        self.client = Client(self.loop, self.viewer.server.port, origin)
        self.step = 500

    def give(self, channel, value, stamp=None):
        data = topics.encode(channel, value)
        stamp = getattr(value, "stamp", 0) if stamp is None else stamp
        self.handlers[channel](Serialized(f"/{channel.lstrip('/')}", stamp, data, topics.message_type(channel)))

    def odometry(self):
        p = (P[0] + 0.001 * self.step, *P[1:])
        for channel in ("ground_truth/odometry", "odometry"):
            self.give(channel, OdometryState(self.step * STEP, p, Q, (0.0,) * 3, (0.0,) * 3, ZERO, ZERO))
        self.step += 1

    def until(self, condition, what, meanwhile=lambda: None):
        end = time.monotonic() + 120.0
        while not condition():
            assert time.monotonic() < end, f"never saw {what}"
            meanwhile()
            self.loop.run_until_complete(asyncio.sleep(0.002))

    def markers(self):
        messages = self.client.of("/markers")
        for _, data in messages[self.seen:]:
            for item in topics.decode(MARKERS, data).markers:
                self.shown.setdefault(item.ns, {})[item.id] = item
        self.seen = len(messages)
        return self.shown

    def close(self):
        self.viewer.close()
        self.until(lambda: self.client.closed, "the end of the connection")
        self.loop.close()


@pytest.fixture
def show():
    found = Show()
    yield found
    found.close()


@pytest.fixture(scope="module")
def served():
    """For tests of who may connect: its end takes half a second."""
    found = Show()
    found.odometry()
    yield found
    found.close()


def test_a_client_sees_topics_with_their_definitions_scene_and_time(show):
    client = show.client
    show.odometry()
    show.until(lambda: "/odometry" in client.channels and "/markers" in client.channels, "the topics")
    odometry = client.channels["/odometry"]
    assert (odometry["encoding"], odometry["schemaName"], odometry["schemaEncoding"]) == ("cdr", "nav_msgs/msg/Odometry", "ros2msg")
    assert odometry["schema"] == message_definition("nav_msgs/msg/Odometry")
    for topic in ("/odometry", "/markers"):
        client.subscribe(topic)
    order = TrajectoryOrder.of(3, rest_to_rest([0, 0, 1.0], [1.0, 0, 1.0], 0.0, 0.0, 2.0), AtEnd.CONTACT)
    show.give("trajectory", order)
    show.give("target/pose", TargetPose(0, np.array([1.7, 0.0, 1.2]), np.array([0.0, -0.70710678, 0.0, 0.70710678]), ZERO))
    show.give("controller/status", ControllerStatus(0, 3, "geometric", 3, 0.0, 2.0, 0.0, 0.0, 0.5, 1.0, "tracking trajectory 3"))
    wanted = {"room", "surface", "pad", "vehicle", "camera_axis", "status", "truth", "plan", "flown", "target"}
    show.until(lambda: wanted <= set(show.markers()) and show.markers()["flown"][0].points, "the scene", show.odometry)
    client.subscribe("/trajectory")  # after it was sent
    show.until(lambda: client.of("/trajectory"), "the trajectory")
    sent, wanted_data = client.of("/trajectory")[0][1], topics.encode("trajectory", order)
    # Fast CDR leaves whatever was in memory between fields that are aligned: the messages are compared, every field of them.
    assert len(sent) == len(wanted_data) and deserialize_message(sent, Trajectory) == deserialize_message(wanted_data, Trajectory)
    shown = show.markers()
    hubs = np.mean([m.p for m in shown["vehicle"].values() if m.shape == Shape.CYLINDER], axis=0)
    assert np.allclose(hubs[1:], P[1:], atol=1e-6)
    assert shown["status"][0].text == "tracking trajectory 3"
    plan = [(x, z) for x, _, z in shown["plan"][0].points]
    assert plan[0] == pytest.approx((0.0, 1.0)) and plan[-1][0] > 0.99
    stamp, data = client.of("/odometry")[-1]
    state = topics.decode("odometry", data)
    assert state.stamp == stamp and state.p_WB[1] == 2.0
    assert client.times and client.times[-1] <= show.step * STEP and client.times[-1] >= 500 * STEP
    assert show.drawn[-1].stamp >= 500 * STEP and {m.ns for scene in show.drawn for m in scene.markers} >= wanted


def test_whoever_comes_late_gets_all_fixed_frames(show):
    description = Description(DescriptionParameters())
    description.static.receivers.append(lambda frame: show.give("/tf_static", frame))
    description.robot_description.receivers.append(lambda text: show.give("robot_description", text))
    description.on_start(0)
    show.odometry()
    show.until(lambda: {"/tf_static", "/robot_description"} <= set(show.client.channels), "the topics")
    for topic in ("/tf_static", "/robot_description"):
        show.client.subscribe(topic)
    show.until(lambda: len(show.client.of("/tf_static")) == 4 and show.client.of("/robot_description"), "the frames")
    frames = [topics.decode("/tf_static", data).child for _, data in show.client.of("/tf_static")]
    assert frames == ["odom", "imu_link", "camera_down_optical_frame", "camera_front_optical_frame"]
    assert "<robot" in topics.decode("robot_description", show.client.of("/robot_description")[0][1])


def test_fast_topics_are_thinned_and_images_are_packed_while_somebody_looks_also_where_time_begins_anew(show):
    client, topic = show.client, "/camera_front/image_raw/compressed"
    pixels, looked = np.zeros((48, 64, 3), np.uint8), []
    pixels[:, :32] = (200, 30, 30)

    def draw(region):
        looked.append(region)
        return pixels

    def fly():
        show.odometry()
        show.handlers["camera_front/image_raw"](CameraImage(show.step * STEP, "camera_front_optical_frame", 64, 48, "rgb8", draw))

    fly()
    show.until(lambda: topic in client.channels and "/odometry" in client.channels, "the topics")
    assert not looked  # an image that nobody looks at is not drawn
    client.subscribe("/odometry")
    client.subscribe(topic)
    show.until(lambda: len(client.of(topic)) >= 2 and len(client.of("/odometry")) >= 5, "images and odometry", fly)
    image = topics.decode("camera_front/image_raw/compressed", client.of(topic)[0][1]).pixels()
    assert image.shape == (48, 64, 3) and image[24, 10, 2] > 150 > image[24, 10, 0]  # red, in BGR
    times = [t for t, _ in client.of("/odometry")]
    assert np.diff(times).min() >= 10_000_000 and np.diff([t for t, _ in client.of(topic)]).min() >= 50_000_000
    show.step = 50
    show.until(lambda: all(np.diff(stamps).min() < 0 for stamps in ([t for t, _ in client.of("/odometry")], [t for t, _ in client.of(topic)],
                                                                    [scene.stamp for scene in show.drawn])), "the flight that began anew", fly)


def test_mapped_cables_come_and_go():
    show = Show("inspection")
    show.odometry()
    show.until(lambda: "/markers" in show.client.channels, "the topics")
    show.client.subscribe("/markers")
    line = MappedPowerline(3, (0.0, 0.0, 0.0), (0.0, 2.0, 0.0), 0.03, np.eye(3), 0.0, 4)
    show.give("powerlines", PowerlineMap(0, (line,), False, ""))
    show.until(lambda: "map" in show.markers(), "the map", show.odometry)
    assert show.markers()["map"][6].points[1][1] == 2.0 and len(show.markers()["cables"]) == 3
    assert sum(m.shape == Shape.TEXT for m in show.markers()["waypoints"].values()) == 6
    show.give("powerlines", PowerlineMap(0, (), False, ""))
    show.until(lambda: show.markers()["map"][6].removed, "the end of the map", show.odometry)
    show.close()


def test_what_cannot_be_drawn_is_warned_of_and_passed_on(show):
    said = []
    show.viewer.log.receivers.append(said.append)
    empty = Trajectory(id=7)
    show.handlers["trajectory"](Serialized("/trajectory", 0, serialize_message(empty), type(empty)))
    assert [line.level for line in said] == ["warning"] and "trajectory is not drawn" in said[0].text
    show.until(lambda: "/trajectory" in show.client.channels, "the topic")
    show.client.subscribe("/trajectory")
    show.until(lambda: show.client.of("/trajectory"), "the trajectory")
    assert deserialize_message(show.client.of("/trajectory")[0][1], Trajectory) == empty


def test_a_port_in_use_is_refused_with_what_to_do(served):
    port = served.viewer.server.port
    with pytest.raises(ConfigError, match=f"viewer: port: 127.0.0.1:{port} cannot be served .*choose another"):
        Viewer(ViewerParameters(port=port))


@pytest.mark.parametrize("origin", ["http://evil.example", "https://evil.example:8765", "null", "https://app.foxglove.dev.evil.example",
                                    "http://localhost.evil.example", "http://app.foxglove.dev", "nonsense"])
def test_pages_of_elsewhere_are_refused(served, origin):
    with pytest.raises(HTTPClientError, match="403"):
        Client(served.loop, served.viewer.server.port, origin)


@pytest.mark.parametrize("origin", [None, "https://app.foxglove.dev", "http://localhost:8080", "http://127.0.0.1:3000", "http://[::1]:8080", "file://"])
def test_foxglove_local_pages_and_programs_are_let_in(served, origin):
    client = Client(served.loop, served.viewer.server.port, origin)
    served.until(lambda: "/odometry" in client.channels, "the topics")
    client.socket.close()
    served.until(lambda: client.closed, "the end of the connection")


def test_origins_are_a_parameter():
    assert not allowed("http://lab.example:80", LOCAL) and allowed("http://lab.example:80", ("http://lab.example",))
    assert allowed("http://lab.example:80", ("http://lab.example:80",)) and not allowed("http://lab.example:81", ("http://lab.example:80",))
    assert allowed("http://evil.example", ("*",)) and not allowed("null", ("null",)) and allowed(None, ())
    show = Show(origin="http://lab.example:80", origins=("http://lab.example",))
    show.close()


def test_the_server_behind_the_gate_listens_on_the_loopback_alone(served):
    host, port = served.viewer.server._gate._backend
    assert host.startswith("127.") and host != "127.0.0.1" and port != served.viewer.server.port


def test_no_handshake_ends_a_connection_and_nothing_else(served):
    async def knock():
        reader, writer = await asyncio.open_connection("127.0.0.1", served.viewer.server.port)
        writer.write(b"x" * 100_000)
        try:
            return await reader.read()
        except ConnectionResetError:
            return b""

    assert served.loop.run_until_complete(asyncio.wait_for(knock(), 120.0)) == b"" and not served.client.closed
    Client(served.loop, served.viewer.server.port)


def test_the_layout_shows_what_is_served():
    text = (config.config_dir() / "foxglove_layout.json").read_text()
    channels = (*FAST, *RARE, *UNLATCHED, MARKERS, *(f"camera_{c}/image_raw/compressed" for c in CAMERAS))
    types = {f"/{channel.lstrip('/')}": topics.message_type(channel) for channel in channels}
    paths = re.findall(r'"(/[a-z_]+[^"]*)"', text)
    assert len(paths) > 15
    for path in paths:
        topic, *fields = path.split(".")
        assert topic in types, path
        if fields:
            msg = types[topic]()
            for name in fields:
                msg = getattr(msg, name.split("[")[0])
                msg = msg[int(name.split("[")[1][:-1])] if "[" in name else msg


def test_every_scenario_has_a_scene_that_can_be_sent():
    files = sorted((config.config_dir() / "scenarios").glob("*.yaml"))
    assert files
    for file in files:
        scenario = load_scenario(file)
        state = OdometryState(0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, ZERO, ZERO)
        found = world_markers(scenario) + vehicle_markers(load_vehicle(scenario.vehicle), state, "hovering")
        names = [(m.ns, m.id) for m in found]
        assert len(set(names)) == len(names)
        sent = topics.decode(MARKERS, topics.encode(MARKERS, Markers(5, tuple(found))))
        assert sent.stamp == 5 and [(m.ns, m.id, m.shape, m.points) for m in sent.markers] == [(m.ns, m.id, m.shape, m.points) for m in found]


def test_a_path_stays_bounded_and_a_map_forgets():
    path = Path()
    for k in range(20000):
        path.add((0.03 * k, 0.0, 0.0))
    assert 1000 < len(path.points) <= 3001 and path.points[0] == (0.0, 0.0, 0.0)
    gone = map_markers(PowerlineMap(0, (), False, ""), {5})
    assert [(m.id, m.removed) for m in gone] == [(10, True), (11, True)]
