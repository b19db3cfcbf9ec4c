"""Node `viewer`: a WebSocket client sees topics, images, markers and frames as Foxglove does; its layout fits what is served."""

import asyncio
import json
import re
import struct

import cv2
import numpy as np
import pytest
import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped
from nav_msgs.msg import Odometry
from perch_core import config
from perch_core.errors import ConfigError
from perch_core.ros import qos
from perch_core.ros.conversions import fill_odometry, to_pose, to_stamp
from perch_core.ros.trajectories import flat_message
from perch_core.scenario import load_scenario
from perch_core.trajectory import rest_to_rest
from perch_core.vehicle import load_vehicle
from perch_eval import viewer_node
from perch_eval.mcap_log import message_class, message_definition
from perch_eval.view.layout import layout_json
from perch_eval.view.scene import Path, map_markers, vehicle_markers, world_markers
from perch_core.ros.wire import OdometryReading
from perch_msgs.msg import ControllerStatus, Powerline, PowerlineArray, Trajectory
from rclpy.experimental import EventsExecutor
from rclpy.parameter import Parameter
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import CompressedImage, Image
from tornado.websocket import websocket_connect
from visualization_msgs.msg import Marker, MarkerArray

STEP_NS = 2_000_000
P, Q = np.array([1.0, 2.0, 1.5]), np.array([0.0, 0.0, 0.6, 0.8])


class Client:
    """Foxglove's side of the protocol."""

    def __init__(self, loop, port):
        self.loop = loop
        self.socket = loop.run_until_complete(self._connect(port))
        self.channels, self.times, self.messages, self.closed = {}, [], {}, False
        loop.create_task(self._read())

    @staticmethod
    async def _connect(port):
        return await websocket_connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])

    async def _read(self):
        while (message := await self.socket.read_message()) is not None:
            if isinstance(message, str):
                content = json.loads(message)
                if content["op"] == "advertise":
                    self.channels |= {c["topic"]: c for c in content["channels"]}
            elif message[0] == 1:
                subscription, time = struct.unpack_from("<IQ", message, 1)
                self.messages.setdefault(subscription, []).append((time, message[13:]))
            elif message[0] == 2:
                self.times.append(struct.unpack_from("<Q", message, 1)[0])
        self.closed = True

    def subscribe(self, topic):
        self.loop.run_until_complete(self._subscribe(self.channels[topic]["id"]))

    async def _subscribe(self, id):
        await self.socket.write_message(json.dumps({"op": "subscribe", "subscriptions": [{"id": id, "channelId": id}]}))

    def of(self, topic):
        return self.messages.get(self.channels[topic]["id"], [])


class Flight:
    """The viewer, a client, and the test as the rest of the graph."""

    def __init__(self, context, scenario):
        self.executor, self.loop = EventsExecutor(context=context), asyncio.new_event_loop()
        overrides = [Parameter("port", value=0), Parameter("scenario", value=scenario)]
        self.viewer = viewer_node.create(context=context, parameter_overrides=overrides)
        self.node = rclpy.create_node("test_graph", context=context)
        self.executor.add_node(self.viewer)
        self.executor.add_node(self.node)
        self.client = Client(self.loop, self.viewer._server.port)
        self.publishers, self.step = {}, 500

    def publish(self, topic, msg, profile):
        if topic not in self.publishers:
            publisher = self.publishers[topic] = self.node.create_publisher(type(msg), topic, profile)
            self.until(lambda: publisher.get_subscription_count() > 0, f"a subscriber of {topic}")
        self.publishers[topic].publish(msg)

    def odometry(self):
        for topic in ("ground_truth/odometry", "odometry"):
            msg = Odometry()
            msg.header.stamp, msg.header.frame_id = to_stamp(self.step * STEP_NS), "map"
            fill_odometry(msg, P + (0.001 * self.step, 0.0, 0.0), Q, np.zeros(3), np.zeros(3))
            self.publish(topic, msg, qos.CHAIN)
        self.step += 1

    def until(self, condition, what, meanwhile=lambda: None):
        for _ in range(1500):
            if condition():
                return
            meanwhile()
            self.executor.spin_once(timeout_sec=0.002)
            self.loop.run_until_complete(asyncio.sleep(0.002))
        raise AssertionError(f"never saw {what}")

    def markers(self):
        shown = {}
        for _, data in self.client.of("/markers"):
            for item in deserialize_message(data, MarkerArray).markers:
                shown.setdefault(item.ns, {})[item.id] = item
        return shown

    def close(self):
        self.viewer.close()
        self.until(lambda: self.client.closed, "the end of the connection")
        for node in (self.viewer, self.node):
            node.destroy_node()
        self.loop.close()


@pytest.fixture
def context(ros_domain):
    found = rclpy.Context()
    rclpy.init(context=found, domain_id=ros_domain)
    yield found
    rclpy.shutdown(context=found)


@pytest.fixture
def flight(context):
    found = Flight(context, "surface_90")
    yield found
    found.close()


def test_a_client_sees_topics_with_their_definitions_scene_and_time(flight):
    client = flight.client
    flight.until(lambda: "/tf" in client.channels and len(client.channels) > 15, "the topics")
    odometry = client.channels["/odometry"]
    assert (odometry["encoding"], odometry["schemaName"], odometry["schemaEncoding"]) == ("cdr", "nav_msgs/msg/Odometry", "ros2msg")
    assert odometry["schema"] == message_definition("nav_msgs/msg/Odometry")
    for topic in ("/odometry", "/markers", "/tf"):
        client.subscribe(topic)
    trajectory = flat_message(rest_to_rest([0, 0, 1.0], [1.0, 0, 1.0], 0.0, 0.0, 2.0))
    trajectory.at_end = Trajectory.AT_END_CONTACT
    flight.publish("trajectory", trajectory, qos.GATED)
    flight.publish("target/pose", target := PoseWithCovarianceStamped(), qos.GATED)
    target.pose.pose = to_pose(np.array([1.7, 0.0, 1.2]), np.array([0.0, -0.70710678, 0.0, 0.70710678]))
    flight.publish("target/pose", target, qos.GATED)
    status = ControllerStatus(message="tracking trajectory 3")
    flight.publish("controller/status", status, qos.CHAIN)
    wanted = {"room", "surface", "pad", "vehicle", "camera_axis", "status", "truth", "plan", "flown", "target"}
    flight.until(lambda: wanted <= set(flight.markers()) and flight.markers()["flown"][0].points and client.of("/tf"), "the scene", flight.odometry)
    client.subscribe("/trajectory")  # after it was sent
    flight.until(lambda: client.of("/trajectory"), "the trajectory")
    assert deserialize_message(client.of("/trajectory")[0][1], Trajectory) == trajectory
    shown = flight.markers()
    hubs = np.mean([[m.pose.position.x, m.pose.position.y, m.pose.position.z] for m in shown["vehicle"].values() if m.type == Marker.CYLINDER], axis=0)
    assert np.allclose(hubs[1:], P[1:], atol=1e-6)
    assert shown["status"][0].text == "tracking trajectory 3"
    plan = [(p.x, p.z) for p in shown["plan"][0].points]
    assert plan[0] == pytest.approx((0.0, 1.0)) and plan[-1][0] > 0.99
    assert {m.header.frame_id for m in shown["vehicle"].values()} == {"map"}
    time, data = client.of("/odometry")[-1]
    msg = deserialize_message(data, Odometry)
    assert msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec == time and msg.pose.pose.position.y == 2.0
    assert client.times and client.times[-1] <= flight.step * STEP_NS and client.times[-1] >= 500 * STEP_NS
    assert client.channels["/tf"]["schemaName"] == "foxglove.FrameTransforms" and b"camera_front_optical_frame" in client.of("/tf")[-1][1]


def test_fast_topics_are_thinned_and_images_are_packed_while_somebody_looks(flight):
    client, topic = flight.client, "/camera_front/image_raw/compressed"
    flight.until(lambda: topic in client.channels, "the topics")
    client.subscribe("/odometry")
    client.subscribe(topic)
    pixels = np.zeros((48, 64, 3), np.uint8)
    pixels[:, :32] = (200, 30, 30)

    def fly():
        flight.odometry()
        msg = Image(height=48, width=64, step=192, encoding="rgb8", data=pixels.tobytes())
        msg.header.stamp = to_stamp(flight.step * STEP_NS)
        flight.publish("camera_front/image_raw", msg, qos.IMAGE)

    flight.until(lambda: len(client.of(topic)) >= 2 and len(client.of("/odometry")) >= 5, "images and odometry", fly)
    image = cv2.imdecode(np.frombuffer(deserialize_message(client.of(topic)[0][1], CompressedImage).data, np.uint8), cv2.IMREAD_COLOR)
    assert image.shape == (48, 64, 3) and image[24, 10, 2] > 150 > image[24, 10, 0]  # red, in BGR
    times = [t for t, _ in client.of("/odometry")]
    assert np.diff(times).min() >= 10_000_000 and np.diff([t for t, _ in client.of(topic)]).min() >= 50_000_000


def test_mapped_cables_come_and_go(context):
    flight = Flight(context, "inspection")
    flight.until(lambda: "/markers" in flight.client.channels, "the topics")
    flight.client.subscribe("/markers")
    line = Powerline(id=3, radius=0.03)
    line.end.y = 2.0
    flight.publish("powerlines", PowerlineArray(lines=[line]), qos.GATED)
    flight.until(lambda: "map" in flight.markers(), "the map", flight.odometry)
    assert flight.markers()["map"][6].points[1].y == 2.0 and len(flight.markers()["cables"]) == 3
    assert sum(m.type == Marker.TEXT_VIEW_FACING for m in flight.markers()["waypoints"].values()) == 6
    flight.publish("powerlines", PowerlineArray(), qos.GATED)
    flight.until(lambda: flight.markers()["map"][6].action == Marker.DELETE, "the end of the map", flight.odometry)
    flight.close()


def test_a_port_in_use_is_refused_with_what_to_do(context):
    first = viewer_node.create(context=context, parameter_overrides=[Parameter("port", value=0)])
    with pytest.raises(ConfigError, match=f"viewer: port: 127.0.0.1:{first._server.port} cannot be served .*choose another"):
        viewer_node.create(context=context, parameter_overrides=[Parameter("port", value=first._server.port)])
    first.close()
    first.destroy_node()


def test_the_layout_is_the_generated_one_and_shows_what_is_served():
    text = (config.config_dir() / "foxglove_layout.json").read_text()
    assert text == layout_json(), "python3 -m perch_eval.view.layout > config/foxglove_layout.json"
    types = {f"/{name}": kind for name, kind in (viewer_node.FAST | viewer_node.RARE).items()} | {"/diagnostics": None, "/markers": None}
    types |= {f"/camera_{c}/image_raw/compressed": None for c in viewer_node.CAMERAS}
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
    for file in sorted((config.config_dir() / "scenarios").glob("*.yaml")):
        scenario = load_scenario(file)
        state = OdometryReading(0, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3)
        found = world_markers(scenario) + vehicle_markers(load_vehicle(scenario.vehicle), state, "hovering")
        names = [(m.ns, m.id) for m in found]
        assert len(set(names)) == len(names) and serialize_message(MarkerArray(markers=found))


def test_a_path_stays_bounded_and_a_map_forgets():
    path = Path()
    for k in range(20000):
        path.add((0.03 * k, 0.0, 0.0))
    assert 1000 < len(path.points) <= 3001 and path.points[0] == (0.0, 0.0, 0.0)
    gone = map_markers(PowerlineArray(), {5})
    assert [(m.id, m.action) for m in gone] == [(10, Marker.DELETE), (11, Marker.DELETE)]
    assert message_class("visualization_msgs/msg/MarkerArray") is MarkerArray
