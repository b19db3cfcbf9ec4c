"""A whole perch on a wall on the real nodes: what the report says of it.

And a seed is a flight: composed, in separate processes and without ROS, whatever the environment says, whoever looks on or talks in.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from perch_eval import demo
from perch_eval.flight import HASHED, Flight, numbers
from perch_eval.mcap_log import read
from perch_eval.nodes import ALL_NODES, executable
from perch_eval.ros.recorded_flight import RecordedFlight
from system import forks
from system.scripts import PATIENCE, ROOT

SCENARIO, SEED = "surface_90", 1
AS_A_USER = ("vio", "target_localizer", "perching_planner")
"""Executables that are started as the demo does, whose others share a process by default: here these are forked."""
WATCHED = (("/odometry", "nav_msgs/msg/Odometry"), ("/camera_front/image_raw", "sensor_msgs/msg/Image"))


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> tuple[dict, Path]:
    """The report and the folder of a flight with all nodes in one process."""
    folder = tmp_path_factory.mktemp("composed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ROS_DOMAIN_ID", "0")  # the demo chooses its own and must not leave it behind
        forks.fork_programs(patch)
        return demo.fly(SCENARIO, SEED, folder, composed=ALL_NODES), folder


def test_it_perches_as_the_paper_does(flight):
    report, _ = flight
    assert report["outcome"] == "perched", report["message"]
    assert max(report["tracking_rmse_m"]) <= 0.11        # [M:Table II], each axis
    assert report["max_body_rate_deg_s"] >= 400.0
    assert report["contact"]["state"] == "attached" and report["contact"]["body"] == "pad"
    assert 0.2 <= report["contact"]["normal_speed_m_s"] <= 1.0 and report["contact"]["tangential_speed_m_s"] <= 0.6
    assert report["contact"]["tilt_error_deg"] <= 15.0 and report["contact"]["offset_m"] <= 0.3


def test_the_report_has_every_figure(flight):
    report, folder = flight
    written = json.loads((folder / "report.json").read_text())
    for key in ("outcome", "scenario", "seed", "tracking_rmse_m", "estimation_rmse_m", "max_body_rate_deg_s", "max_acceleration_m_s2",
                "contact", "real_time_factor", "flight_hash", "timings_ms"):
        assert written[key] is not None, key
    assert (written["scenario"], written["seed"]) == (SCENARIO, SEED)
    assert len(written["estimation_rmse_m"]) == 3 and all(0.0 < v < 1.0 for v in written["estimation_rmse_m"])
    assert re.fullmatch("[0-9a-f]{64}", written["flight_hash"])
    assert written["real_time_factor"] > 0.0
    for node in ("vio", "estimator", "target_localizer", "controller"):
        durations = written["timings_ms"][node]
        assert durations and all(math.isfinite(v) for v in durations.values())


def test_the_nodes_hold_their_rates(flight):
    report, folder = flight
    rates = report["rates_hz"]
    for topic, rate in (("imu/data_raw", 500.0), ("odometry", 500.0), ("motor_command", 500.0), ("ground_truth/odometry", 500.0),
                        ("rotor_state", 100.0), ("controller/status", 50.0), ("estimator/status", 10.0)):
        assert rates[topic] == pytest.approx(rate, rel=0.05), topic
    until_contact = [t for t, _ in RecordedFlight(folder / "flight.mcap").values("vio/odometry") if t <= report["window_s"][1]]
    assert len(until_contact) > 100  # at the wall it is blind, and says nothing
    assert np.ptp(until_contact) / (len(until_contact) - 1) == pytest.approx(1.0 / 30.0, rel=0.03)


def test_the_recording_opens_as_ros_2_messages(flight):
    _, folder = flight
    with (folder / "flight.mcap").open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary.statistics.message_count > 10_000
    schemas = {channel.topic: summary.schemas[channel.schema_id] for channel in summary.channels.values()}
    assert all(schema.encoding == "ros2msg" and schema.data for schema in schemas.values())
    assert schemas["/odometry"].name == "nav_msgs/msg/Odometry"
    assert b"MSG: geometry_msgs/Quaternion" in schemas["/odometry"].data
    assert {"/camera_front/image_raw/compressed", "/trajectory", "/target/pose", "/diagnostics"} <= set(schemas)


def test_the_page_is_complete(flight):
    report, folder = flight
    page = (folder / "report.html").read_text()
    for title in ("Timeline", "Tracking and estimation", "Body rates", "Thrust against its bounds", "Camera images", "Rates", "Times"):
        assert f"<h2>{title}" in page
    assert page.count("data:image/png;base64,") == 5 and page.count("data:image/webp;base64,") == 1
    assert report["flight_hash"][:16] in page and "attached to pad" in page
    assert not re.search(r"\bnan\b|None", re.sub(r'src="[^"]*"', "", page))


def test_everything_is_logged_at_a_time_of_the_flight(flight):
    report, folder = flight
    assert logged_outside(folder / "flight.mcap", report["simulated_time_s"]) == []


@pytest.fixture
def crowd(ros_domain, tmp_path, monkeypatch) -> Iterator[list[forks.Forked]]:
    """A foreign publisher on every topic, a viewer and two who measure rates, in the domain that the next demo flies in."""
    monkeypatch.setattr(demo, "domain_in_environment", lambda: contextlib.nullcontext(ros_domain))
    topic = str(ROOT / "scripts" / "topic.py")
    with (tmp_path / "crowd.log").open("w+") as log:
        everybody = [forks.Forked(forks.NODES, [str(Path(__file__).with_name("stranger.py"))], log, log),
                     forks.Forked(forks.NODES, [executable("perch_eval", "viewer"), "--ros-args", "-p", "port:=0"], log, log),
                     *(forks.Forked(forks.SCRIPTS, [topic, "hz", *watched], log, log) for watched in WATCHED)]
        try:
            end = time.monotonic() + PATIENCE
            while "up\n" not in (tmp_path / "crowd.log").read_text():
                assert everybody[0].poll() is None and time.monotonic() < end
                time.sleep(0.05)
            yield everybody
        finally:
            for process in everybody:
                process.terminate()
            for process in everybody:
                process.wait(PATIENCE)


def test_one_process_per_node_in_a_crowd_is_the_same_flight(flight, crowd, tmp_path, monkeypatch):
    """The crowd keeps both cores busy, too. A report is not drawn again."""
    def only_the_hash(out, scenario, seed, outcome, message, wall_time, end_time, start_time):
        return {"flight_hash": RecordedFlight(out / "flight.mcap").digest(end_time), "outside": logged_outside(out / "flight.mcap", end_time)}

    report, folder = flight
    monkeypatch.setattr("perch_eval.report.build_report", only_the_hash)
    forks.fork_programs(monkeypatch, AS_A_USER)
    again = demo.fly(SCENARIO, SEED, tmp_path, composed=())
    assert not {" ".join(process.args): process.poll() for process in crowd if process.poll() is not None}
    if again["flight_hash"] != report["flight_hash"]:
        pytest.fail(first_difference(RecordedFlight(folder / "flight.mcap"), RecordedFlight(tmp_path / "flight.mcap")))
    log = (tmp_path / "logs" / "vehicle.log").read_text()
    for topic in ("trajectory", "controller/command", "motor_command", "odometry", "imu/data_raw"):
        assert log.count(f"[vehicle]: {topic}: /stranger publishes it but is not a participant of the lockstep: ignored") == 1, topic
    assert log.count("[vehicle]: /clock: /stranger publishes it, too: the clocks of nodes in other processes follow both") == 1
    assert again["outside"] == []


def test_without_ros_and_with_sums_on_two_threads_it_is_the_same_flight(flight):
    """In a process of its own, whose BLAS is told so before it is loaded; the demo's nodes add on one."""
    report, _ = flight
    program = ("import sys; from perch_sim.scenario import load_scenario; from perch_eval.in_process import fly\n"
               "from perch_eval.in_process.flights import Sensing\n"
               "trace = fly(load_scenario(sys.argv[1]), int(sys.argv[2]), Sensing('rendered', 'rendered'), linger=0.5)\n"
               "print(trace.flight.digest(trace.end_time))")
    environment = {**os.environ, **dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "2")}
    flown = subprocess.run([sys.executable, "-c", program, SCENARIO, str(SEED)], check=True, capture_output=True, text=True, env=environment)
    assert flown.stdout.strip() == report["flight_hash"]


def logged_outside(recording: Path, end_time: float) -> list[tuple[str, float]]:
    """Messages, with the time at which they are logged [s], outside a flight."""
    return [(topic, 1e-9 * time) for topic, _, time, _ in read(recording) if not 0 <= time <= 1e9 * (end_time + 1.0)]


def first_difference(a: Flight, b: Flight) -> str:
    """Where two recordings part, topic by topic."""
    lines = []
    for topic in HASHED:
        one, other = a.values(topic), b.values(topic)
        parted = next((t for (t, x), (_, y) in zip(one, other) if numbers(x) != numbers(y)), None)
        lines.append(f"{topic}: {len(one)} and {len(other)} values, " + ("equal" if parted is None else f"different from {parted:.3f} s on"))
    return "\n".join(lines)
