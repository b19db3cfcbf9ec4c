"""The simulated vehicle as a component: what it emits when, in lockstep and in real time, and what it refuses."""

from __future__ import annotations

import dataclasses
import os
import signal

import numpy as np
import pytest
import yaml
from perch_core import config
from perch_core.errors import ConfigError
from perch_core.values import MotorCommand, RatesThrust
from perch_sim.contact_event import ContactState
from perch_sim.drawing import ProcessRendering, OnDemandRendering
from perch_sim.lockstep import Schedule, flight_tasks
from perch_sim.parameters import VehicleParameters
from perch_sim.scenario import load_scenario
from perch_sim.simulated_vehicle import SimulatedVehicle

MS = 1_000_000
SCENARIO = load_scenario("surface_90")


def vehicle(cameras: str = "none", scenario=SCENARIO, drawing=OnDemandRendering, seed: int = 3) -> tuple[SimulatedVehicle, dict[str, list]]:
    """A vehicle, and what it emits by port."""
    made, seen = SimulatedVehicle(VehicleParameters(seed=seed, cameras=cameras), scenario, drawing), {}
    for port in ("imu", "truth", "target", "rotors", "contact", "clock", "frames", "info_down", "image_down", "info_front", "image_front",
                 "log", "diagnostics"):
        seen[port] = []
        getattr(made, port).receivers.append(seen[port].append)
    return made, seen


def test_each_output_comes_at_its_rate_and_tells_the_truth():
    flown, seen = vehicle()
    states, model = [], flown.simulation.vehicle
    lift = float(np.sqrt(1.4 * model.hover_thrust / 4 / model.thrust_coefficient))
    for _ in range(250):
        flown.advance()
        flown.on_motor_command(MotorCommand(flown.time, True, (lift, 0.998 * lift, lift, lift)))
        states.append(flown.simulation.state)
    stamps = [1_000 * MS + 2 * MS * (k + 1) for k in range(250)]
    assert [sample.stamp for sample in seen["imu"]] == [state.stamp for state in seen["truth"]] == stamps
    assert seen["clock"] == [rotors.stamp for rotors in seen["rotors"]] == stamps[::5]
    assert [(frame.parent, frame.child) for frame in seen["frames"]] == [
        ("base_link", "imu_link"), ("base_link", "camera_down_optical_frame"), ("base_link", "camera_front_optical_frame")]
    assert [(pose.stamp, pose.p) for pose in seen["target"]] == [(stamps[0], tuple(SCENARIO.surface.p_WS.tolist()))]
    assert seen["contact"][0].state == ContactState.GROUND and seen["contact"][0].body == "floor"
    for told, true in zip(seen["truth"], states):
        assert (told.p_WB, told.q_WB, told.w_B) == tuple(tuple(x.tolist()) for x in (true.p_WB, true.q_WB, true.w_WB_B))
        assert np.allclose(told.v_WB, true.v_WB, atol=1e-12) and not told.pose_covariance.any()
    assert states[-1].v_WB[2] > 0.5  # it left the ground


def test_a_moving_pad_is_told_a_hundred_times_a_second():
    moving = dataclasses.replace(SCENARIO, target=dataclasses.replace(SCENARIO.target, velocity=(0.1, 0.0, 0.0)))
    flown, seen = vehicle(scenario=moving)
    for _ in range(50):
        flown.advance()
    assert len(seen["target"]) == 10
    assert seen["target"][-1].p[0] - seen["target"][0].p[0] == pytest.approx(0.1 * 0.09)


def test_nothing_is_made_for_nobody():
    flown, asked = SimulatedVehicle(VehicleParameters(cameras="none")), {"imu": True, "truth": False, "rotors": False}
    made = {name: [] for name in asked}
    for name, wanted in asked.items():
        emitter = getattr(flown, name)
        emitter.receivers.append(made[name].append)
        emitter.receiver_check = lambda wanted=wanted: wanted
    for _ in range(10):
        flown.advance()
    assert {name: len(values) for name, values in made.items()} == {"imu": 10, "truth": 0, "rotors": 0}


@pytest.mark.parametrize("speeds, words", [((1.0, float("nan"), 1.0, 1.0), "not finite"), ((500.0,) * 3, "3 entries, needs 4")])
def test_commands_that_no_motor_follows_are_refused_and_the_last_good_one_counts(speeds, words):
    flown, seen = vehicle()
    flown.advance()
    flown.on_motor_command(MotorCommand(flown.time, True, (500.0,) * 4))
    flown.on_motor_command(MotorCommand(flown.time, True, speeds))
    for _ in range(20):
        flown.advance()
    assert [line.level for line in seen["log"] if words in line.text] == ["error"]
    assert flown.simulation.plant.rotor_speed.min() > 300.0
    flown.diagnose()
    assert seen["diagnostics"][-1].values["commands_refused"] == 1 and seen["diagnostics"][-1].level == 0
    for _ in range(40):
        flown.advance()
    flown.diagnose()
    assert seen["diagnostics"][-1].message == "motors stopped: no motor_command"


def test_a_command_that_was_overtaken_does_not_undo_the_newer_one():
    flown, seen = vehicle()
    stamps = []
    for _ in range(30):
        flown.advance()
        stamps.append(flown.time)
        if len(stamps) > 1:
            flown.on_motor_command(MotorCommand(stamps[-1], True, (500.0,) * 4))
            flown.on_motor_command(MotorCommand(stamps[-2], False, (0.0,) * 4))
    assert flown.simulation.plant.rotor_speed.min() > 300.0
    assert [line.text for line in seen["log"] if "older than the one before" in line.text]


def test_commands_that_are_refused_do_not_make_the_good_ones_look_old():
    """A stranger that publishes another kind of command, with newer stamps, stops no motors."""
    flown, _ = vehicle()
    stamps = []
    for _ in range(60):
        flown.advance()
        stamps.append(flown.time)
        flown.on_rates_thrust(RatesThrust(flown.time, True, (0.0, 0.0, 0.0), 9.81))
        flown.on_motor_command(MotorCommand(stamps[max(len(stamps) - 2, 0)], True, (500.0,) * 4))
    assert flown.simulation.plant.rotor_speed.min() > 300.0 and not flown.simulation.motors.timed_out


@pytest.mark.slow
def test_frames_arrive_with_their_model_and_an_image_that_is_drawn_when_it_is_looked_at():
    flown, seen = vehicle("front")
    arrivals = [arrival for _ in range(100) for arrival in flown.advance()]
    front = [arrival for arrival in arrivals if arrival.camera == "front"]
    stamps = [arrival.stamp for arrival in front]
    assert 4 <= len(front) <= 7 and stamps == [i.stamp for i in seen["info_front"]] == [i.stamp for i in seen["image_front"]]
    assert all(a.image is not None for a in front) and all(a.image is None for a in arrivals if a.camera == "down")
    assert len(seen["info_down"]) == len(arrivals) - len(front) and not seen["image_down"]
    image, model = seen["image_front"][-1], seen["info_front"][-1]
    assert image.ready is None and model.frame == image.frame == "camera_front_optical_frame"
    assert (image.width, image.height, image.encoding) == (model.camera.width, model.camera.height, "mono8")
    assert image.pixels().shape == (480, 640) and image.pixels().std() > 1.0
    assert all(0 < flown.time - a.middle for a in front) and all(abs(a.stamp - a.middle) < 20 * MS for a in front)


@pytest.mark.slow
def test_each_reader_of_an_image_gets_the_region_that_it_asks_for():
    flown, seen = vehicle("front")
    while not seen["image_front"]:
        flown.advance()
    image, first, inner = seen["image_front"][0], (slice(100, 200), slice(200, 300)), (slice(120, 180), slice(210, 290))
    part = image.pixels(first)
    assert image.pixels(inner) is part and not part[300:].any()
    whole = image.pixels((slice(0, 400), slice(0, 300)))
    assert np.array_equal(whole[first], part[first]) and min(whole.mean(axis=0).min(), whole.mean(axis=1).min()) > 10.0
    assert image.pixels() is whole


@pytest.mark.slow
def test_images_that_processes_draw_are_waited_for_and_a_camera_whose_process_ends_goes_on_without():
    expected, on_demand = vehicle("front")
    for _ in range(60):
        expected.advance()
    drawn, seen = vehicle("front", drawing=ProcessRendering)
    try:
        schedule = Schedule(drawn, [], flight_tasks(SCENARIO.latency))
        while schedule.index < 60:
            if not schedule.advance():
                assert schedule.pending()[0].name == "camera_front" and schedule.await_image(1.0)
        image = seen["image_front"][0]
        while not image.ready(1.0):
            pass
        assert np.array_equal(image.pixels(), on_demand["image_front"][0].pixels())
        os.kill(drawn._drawing._clients["front"].process.pid, signal.SIGKILL)
        while schedule.index < 250:
            if not schedule.advance():
                assert schedule.await_image(1.0)
        assert len(seen["info_front"]) > len(seen["image_front"]) + 2
        assert [line.text for line in seen["log"] if line.level == "error"] == [
            "camera_front: the process that renders its images has ended: no more images"]
    finally:
        drawn.close()


def test_in_real_time_the_hosts_time_paces_the_flight_and_what_was_missed_is_told():
    flown, seen = vehicle()
    flown.on_pace(10_000 * MS)
    assert flown.time == 1_000 * MS
    flown.on_pace(10_002 * MS)
    flown.on_motor_command(MotorCommand(flown.time, True, (500.0,) * 4))
    flown.on_pace(10_003 * MS)
    assert flown.time == 1_002 * MS
    flown.on_pace(10_008 * MS)  # three at once: the first has its command, the others do not
    assert flown.time == 1_008 * MS
    flown.on_motor_command(MotorCommand(flown.time, True, (500.0,) * 4))
    flown.on_pace(10_508 * MS)  # away for 500 ms: 25 steps are made up for, the rest is given up
    assert flown.time == 1_058 * MS
    flown.diagnose()
    values = seen["diagnostics"][-1].values
    assert values["periods_skipped"] == 225 and values["deadlines_missed"] == 2 + 249 and values["commands_missed"] == 2 + 24
    now = 10_508 * MS
    for _ in range(600):
        now += 2 * MS
        flown.on_pace(now)
    assert len(seen["diagnostics"]) == 2 and seen["diagnostics"][-1].stamp == 2_058 * MS


def test_calls_in_time_advance_one_step_each_whatever_the_rounding_of_their_times():
    flown, _ = vehicle()
    rng, begin = np.random.default_rng(1), 10_000 * MS
    flown.on_pace(begin)
    for k in range(1, 200):
        flown.on_pace(begin + 2 * MS * k + int(rng.integers(-50_000, 50_000)))
        assert flown.time == 1_000 * MS + 2 * MS * k


@pytest.mark.parametrize("lost, told", [(0, False), (8, False), (2, True)])
def test_commands_that_get_lost_on_their_way_are_told(lost, told):
    """One of `lost`; 0: none."""
    flown, seen = vehicle()
    flown.on_pace(0)
    said = []
    flown.log.receivers.append(lambda line: said.append(line.text) if line.level == "warning" else None)
    for k in range(1, 1_100):
        if not lost or k % lost:
            flown.on_motor_command(MotorCommand(flown.time, True, (500.0,) * 4))
        flown.on_pace(2 * MS * k)
    assert set(said) == ({"50 % of the controller's commands are lost or late"} if told else set())
    assert (seen["diagnostics"][-1].level == 1) == told


def test_in_real_time_images_come_when_they_are_drawn_and_at_most_two_are_being_drawn():
    pending = []

    class Slow:
        def __init__(self, scenario, seed, cameras):
            self.cameras = tuple(cameras)

        def draw(self, camera, exposure):
            pending.append(Coming())
            return pending[-1]

    class Coming:
        on_demand, drawn = False, False

        def done(self, timeout=0.0):
            return self.drawn

        def result(self, region=None):
            return np.zeros((480, 640), np.uint8)

    flown, seen = vehicle("front", drawing=Slow)
    flown.on_pace(0)
    for k in range(1, 101):
        flown.on_pace(2 * MS * k)
    assert len(pending) == 2 and not seen["image_front"] and not seen["info_front"]
    for image in pending:
        image.drawn = True
    for k in range(101, 111):
        flown.on_pace(2 * MS * k)
    assert len(seen["image_front"]) == 2 < len(seen["info_front"])
    flown.diagnose()
    assert seen["diagnostics"][-1].values["images_dropped"] >= 2 and seen["diagnostics"][-1].values["images_late"] > 50


def test_cameras_that_are_not_simulated_are_refused(tmp_path):
    text = config.find("vehicles", "snapdragon").read_text().replace("  front:\n", "  rear:\n")
    (tmp_path / "other.yaml").write_text(text)
    with pytest.raises(ConfigError, match="cameras.rear: is not one of down, front"):
        vehicle(scenario=dataclasses.replace(SCENARIO, vehicle=str(tmp_path / "other.yaml")))


def test_a_vehicle_may_have_one_camera(tmp_path):
    content = config.read_yaml(config.find("vehicles", "snapdragon"))
    (tmp_path / "one.yaml").write_text(yaml.safe_dump(content | {"cameras": {"down": content["cameras"]["down"]}}))
    scenario = dataclasses.replace(SCENARIO, vehicle=str(tmp_path / "one.yaml"))
    flown, seen = vehicle("all", scenario)
    arrivals = [arrival for _ in range(60) for arrival in flown.advance()]
    assert {arrival.camera for arrival in arrivals} == {"down"} and arrivals[0].image.pixels().std() > 1.0 and not seen["info_front"]
    with pytest.raises(ConfigError, match="one.yaml: cameras.front: missing"):
        vehicle("front", scenario)


class Firmware:
    """Stands in for Betaflight: motors follow throttle and arming switch."""

    def __init__(self, loaded) -> None:
        pass

    def step(self, gyro, accel, attitude, channels):
        return (max(0.055, 0.055 + 0.945e-3 * (channels[2] - 1000)) if channels[4] > 1500 else 0.0,) * 4

    def close(self) -> None:
        pass


def test_a_controller_that_is_started_again_does_not_end_the_descent_of_a_firmware(monkeypatch):
    monkeypatch.setattr("perch_autopilot.loop.Sitl", Firmware)
    flown, _ = vehicle(scenario=dataclasses.replace(SCENARIO, vehicle="betaflight_unidentified"))
    simulation = flown.simulation
    simulation.plant.place(np.array([-1.0, 0.0, 3.0]), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3), np.zeros(3), np.full(4, 1268.0))

    def fly(steps, armed):
        for _ in range(steps):
            if armed is not None:
                flown.on_rates_thrust(RatesThrust(flown.time, armed, (0.0, 0.0, 0.0), 9.81 if armed else 0.0))
            flown.advance()
        return simulation.plant.rotor_speed.min()

    assert fly(100, True) > 1000.0 and simulation.motors.starts == 1
    assert fly(400, None) > 1000.0   # level, then descending
    assert fly(100, False) > 1000.0  # a controller that was started again sends commands with the motors off
    assert fly(10, True) > 1000.0
    assert fly(300, False) < 50.0    # in command again, it stops them
