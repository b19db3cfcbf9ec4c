"""Margins of a flight, and two recorded flights side by side."""

import json
import math
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from unit.recorded_flights import flown, record

from perch_core.vehicle import load_vehicle
from perch_eval import comparison, plots
from perch_eval.flight import Flight
from perch_eval.flight_view import FlightView
from perch_eval.margins import margin_text, limits, margins
from perch_eval.ros.recorded_flight import RecordedFlight
from perch_sim.scenario import load_scenario


def test_margins_are_distances_to_the_limits_of_vehicle_and_material(recorded):
    _, flight = recorded
    vehicle, scenario = load_vehicle("snapdragon"), load_scenario("surface_90")
    found = {one["name"]: one for one in margins(flight, vehicle, scenario)}
    assert found["greatest collective thrust"]["left"] == pytest.approx(4 * vehicle.thrust_max - 2.4)
    assert found["least collective thrust"]["left"] == pytest.approx(2.4 - 4 * vehicle.thrust_min)
    assert found["greatest body rate (limit of the plan)"]["left"] == pytest.approx(math.degrees(vehicle.body_rate_max - 0.5))
    low, high = scenario.adhesion.normal_speed
    assert found["normal speed at contact"]["left"] == pytest.approx(min(0.7 - low, high - 0.7))
    assert found["tilt error at contact"]["left"] == pytest.approx(scenario.adhesion.tilt_error_max_deg - math.degrees(0.02))
    strict = replace(scenario, adhesion=replace(scenario.adhesion, tangential_speed_max=0.08))
    assert [one["name"] for one in margins(flight, vehicle, strict) if one["left"] < 0.0] == ["tangential speed at contact"]
    assert "contact" not in "".join(one["name"] for one in margins(flight, vehicle))


def test_margins_at_a_cable_are_those_of_the_gripper():
    """Limits of 0.1 m, 0.3 m/s in all, 10 deg; the contact is 3 cm off, with 0.16 and 0.12 m/s, tilted by 0.02 rad."""
    scenario = load_scenario("line_180")
    scenario = replace(scenario, grip=replace(scenario.grip, position=0.1, speed=0.3, tilt_deg=10.0))
    channels = flown()
    channels["contact"][-1:] = [(3.4, channels["contact"][-1][1]._replace(body="cable 0", normal_speed=0.16, tangential_speed=0.12))]
    found = {one["name"]: one["left"] for one in margins(Flight(channels), load_vehicle("snapdragon"), scenario)}
    assert {name: left for name, left in found.items() if "contact" in name} == pytest.approx({
        "distance of the cable at contact": 0.07, "tilt error at contact": 10.0 - math.degrees(0.02), "speed at contact": 0.1})


def test_limits_are_words_also_after_json():
    assert [limits({"low": low, "high": high}) for low, high in ((0.2, 1.0), (-math.inf, 4.5), (None, 4.5), (0.5, None))] == [
        "0.2 to 1", "at most 4.5", "at most 4.5", "at least 0.5"]


@pytest.mark.parametrize("value, left, said", [
    (0.71234, 0.28766, "0.712 m/s (at most 1 m/s): +0.288 m/s left"), (1146.4, -1145.4, "1150 m/s (at most 1 m/s): -1150 m/s left")])
def test_a_margin_in_words_has_units_and_three_digits(value, left, said):
    assert margin_text({"value": value, "low": None, "high": 1.0, "unit": "m/s", "left": left}) == said


def compared(page):
    """(figure) -> cells of its row, and the verdict, of a page."""
    rows = re.findall(r"<tr><th>([^<]*)</th>((?:<td>[^<]*</td>)+)</tr>", page)
    return {name: re.findall("<td>([^<]*)</td>", cells) for name, cells in rows}, re.search(r"<p>(The two are [^.,]*)", page)[1]


@pytest.mark.slow
def test_two_flights_are_on_one_page(reported, tmp_path):
    """The first flight is off by 5 cm of estimate more in y, and was not reported."""
    channels = flown()
    channels["odometry"] = [(t, state._replace(p_WB=tuple(np.add(state.p_WB, (0.0, 0.05, 0.0))))) for t, state in channels["odometry"]]
    record(tmp_path / "flight.mcap", channels)
    page = tmp_path / "pages" / "ab.html"
    assert comparison.main([str(tmp_path), str(reported[0] / "flight.mcap"), "--names", "<one>", "other", "--out", str(page)]) == 0
    text = page.read_text()
    rows, verdict = compared(text)
    assert verdict == "The two are different flights"
    assert rows["estimation RMSE y [cm]"] == ["5.00", "0.00", "-5.00"] and rows["tracking RMSE x [cm]"] == ["0.00", "0.00", "+0.00"]
    assert rows["outcome"] == ["-", "perched", ""] and rows["seed"] == ["-", "3", ""] and rows["message"][1] == "held &lt;by velcro&gt;"
    assert rows["tilt error at contact [deg]"][:2] == ["at most 15", "-"], "limits of the material are those of the report"
    assert text.count("data:image/png;base64,") == 5 and "<one>" not in text


def test_each_flight_has_its_pad_and_its_wires_where_they_differ(recorded):
    view = FlightView.from_flight(recorded[1], load_vehicle("snapdragon"), "one", "#111111")
    wire = np.array([[[1.0, -1.0, 2.0], [1.0, 1.0, 2.0]]])
    one = replace(view, cables=wire)
    other = replace(one, name="other", colour="#222222", pad=(view.pad[0] + [0.5, 0.0, 0.2], view.pad[1]), cables=wire + 0.3)

    def drawn(*views):
        lines = plots.path_figure(*views).axes[0].lines
        return [(line.get_label(), line.get_color(), line.get_xdata()[0]) for line in lines if line.get_label().endswith(("pad", "cable"))]

    assert drawn(one, other) == [("one, pad", "#111111", pytest.approx(2.0)), ("other, pad", "#222222", pytest.approx(2.5)),
                                 ("one, cable", "#111111", pytest.approx(1.0)), ("other, cable", "#222222", pytest.approx(1.3))]
    assert [line[:2] for line in drawn(one, replace(one, name="same"))] == [("pad", "k"), ("cable", "k")]
    assert [line[0] for line in drawn(replace(one, pad=None), other)][0] == "other, pad"


@pytest.mark.slow
def test_the_report_of_another_flight_is_not_used(reported, tmp_path, capsys):
    channels = flown()
    channels["odometry"] = channels["odometry"][5:]
    record(tmp_path / "flight.mcap", channels)
    shutil.copy(reported[0] / "report.json", tmp_path)
    side = comparison.read("other", "k", tmp_path)
    assert "scenario" not in side.report and not any("contact" in one["name"] for one in side.report["margins"])
    assert "is not the report of" in capsys.readouterr().err


@pytest.mark.slow
def test_limits_that_differ_are_both_told(reported):
    one = comparison.read("one", "k", reported[0])
    other = replace(one, report=one.report | {"margins": [dict(m, high=12.0) for m in one.report["margins"] if m["unit"] == "N"]})
    assert f"at most {4 * load_vehicle('snapdragon').thrust_max:.3g} / at most 12</td>" in comparison._margin_table((one, other))


@pytest.mark.slow
@pytest.mark.parametrize("page", ["report", "comparison"])
def test_a_flight_can_be_turned_on_a_page_that_needs_no_network(page, reported, tmp_path, undrawn):
    folder, _ = reported
    file = folder / "report.html"
    if page == "comparison":
        file = tmp_path / "comparison.html"
        assert comparison.main([str(folder), str(folder), "--out", str(file)]) == 0
        assert compared(file.read_text())[1] == "The two are the same flight"
    text = file.read_text()
    assert not re.search(r"""(?:src|href)=["'](?!data:)|https?://|@import|fetch\(""", text)
    found = json.loads(re.search(r'<script type="application/json">(.*?)</script>', text)[1])["flights"]
    assert len(found) == (1 if page == "report" else 2)
    for one in found:
        assert len(one["t"]) == len(one["p"]) == len(one["q"]) > 100 and len(one["pad"]) == 4 and len(one["rotors"]) == 4
        assert np.ptp([p[0] for p in one["p"]]) == pytest.approx(2.0, abs=0.02)


@pytest.mark.parametrize("content, words", [
    (None, "flight.mcap: no such recording"), (b"text", "holds no ground_truth/odometry"), ("report", "report.json: cannot be read")])
def test_what_cannot_be_compared_is_one_line(content, words, recorded, tmp_path, capsys):
    path, _ = recorded
    if content == "report":
        shutil.copy(path, tmp_path)
        (tmp_path / "report.json").write_text("{")
    elif content is not None:
        (tmp_path / "flight.mcap").write_bytes(content)
    assert comparison.main([str(path), str(tmp_path), "--out", str(tmp_path / "page.html")]) == 2
    said = [line for line in capsys.readouterr().err.splitlines() if not line.startswith("warning: ")]
    assert len(said) == 1 and said[0].startswith("error: ") and words in said[0]
    assert not (tmp_path / "page.html").exists()


def test_the_hash_of_a_flight_is_computed_once(recorded, monkeypatch):
    computed, digest = [], RecordedFlight.digest
    monkeypatch.setattr(RecordedFlight, "digest", lambda self, until: computed.append(until) or digest(self, until))
    side = comparison.read("one", "k", recorded[0])
    assert side.digest(side.until) == recorded[1].digest(side.until) and computed == [side.until]
