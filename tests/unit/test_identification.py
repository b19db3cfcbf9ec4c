"""Identification: what a record was made with is found, with honest deviations, and what it does not tell is refused."""

from dataclasses import replace

import numpy as np
import pytest
from perch_core import config
from perch_core.errors import PerchError
from perch_core.values import ImuSample, OdometryState, RatesThrust
from perch_core.vehicle import Battery, load_vehicle
from perch_eval.flight import Flight
from perch_eval.identification import command, responses
from perch_eval.identification.fit import Estimate, battery, identify, rates, thrust
from perch_eval.identification.flight import Record, record_of
from scipy.signal import lfilter, lfiltic

VEHICLE = load_vehicle("snapdragon_rates")
LAG, GAIN, DELAY, THRUST_LAG, THRUST_GAIN, DRAG = (0.05, 0.04, 0.11), (1.0, 0.9, 1.05), 0.012, 0.07, 0.93, (0.05, 0.04, 0.03)
PERIOD, FINE = 0.002, 20  # of commands and IMU [s]; steps of the test's own integration in one


def record(size=2.5, seconds=20.0, seed=1, oscillation=0.0, lags=LAG, gains=GAIN, delay=DELAY):
    """Commands held for a period, answers integrated in fine steps, IMU samples that are means over a period, with noise."""
    rng, n = np.random.default_rng(seed), round(seconds / PERIOD)
    command_t = PERIOD * np.arange(n)
    smooth = np.exp(-0.5 * (np.arange(-150, 151) / 30.0) ** 2)
    u = np.stack([np.convolve(rng.standard_normal(n), smooth / np.sqrt(np.sum(smooth**2)), "same") for _ in range(4)], axis=1) * size
    u[:, 3] = 9.81 + u[:, 3]
    fine = PERIOD / FINE
    held = u[np.clip((np.arange(n * FINE) - round(delay / fine)) // FINE, 0, None)]
    wanted, answer, speed = held * (*gains, THRUST_GAIN), np.zeros((n * FINE, 4)), np.zeros((n, 3))
    start = np.array([0.0, 0.0, 0.0, 9.81 * THRUST_GAIN])
    for i, lag in enumerate((*lags, THRUST_LAG)):
        if oscillation:  # dx += fine (w^2 (wanted - x) - 0.1 w dx), then x += fine dx
            spring, damping = (fine * oscillation)**2, 0.1 * fine * oscillation
            b, a = [spring], [1.0, spring + damping - 2.0, 1.0 - damping]
        else:            # x += fine (wanted - x) / lag
            b, a = [fine / lag], [1.0, fine / lag - 1.0]
        at_rest = lfiltic(b, a, [start[i]] * (len(a) - 1))
        answer[:, i] = lfilter(b, a, wanted[:, i], zi=at_rest)[0]
    y = answer.reshape(n, FINE, 4).mean(axis=1)
    for i, T in enumerate((1.7, 2.3, 2.9)):
        speed[:, i] = 0.8 * np.sin(2 * np.pi * command_t / T)
    gyro = y[:, :3] + 0.01 * rng.standard_normal((n, 3)) + 0.004
    accel = -np.array(DRAG) / VEHICLE.mass * speed + 0.316 * rng.standard_normal((n, 3))
    accel[:, 2] += y[:, 3]
    # A sample that is the mean over the period from command k to command k + 1 has the stamp of its end.
    return Record(command_t + PERIOD, gyro, accel, speed, command_t, u[:, :3], u[:, 3])


@pytest.fixture(scope="module")
def found():
    return {one.key: one for one in identify(record(), VEHICLE)[0]}


@pytest.mark.slow
def test_what_a_record_was_made_with_is_found(found):
    true = {f"actuation.rate_{name}[{i}]": values[i] for name, values in (("lag", LAG), ("gain", GAIN)) for i in range(3)}
    true |= {"actuation.delay": DELAY, "actuation.thrust_lag": THRUST_LAG, "actuation.thrust_gain": THRUST_GAIN}
    true |= {f"drag[{i}]": DRAG[i] for i in range(3)}
    assert set(found) == set(true)
    for key, value in true.items():
        one = found[key]
        assert abs(one.value - value) < max(4.0 * one.sigma, 0.01 * value), str(one)
        if not key.startswith("drag"):
            assert not one.reason and one.sigma < 0.1 * value, str(one)


def test_what_the_delay_leaves_open_is_open_for_the_lags():
    """What an answer is later by is told, and not how it is shared between the two."""
    one = record()
    (early, _), _ = rates(one, 0, 0.010)
    (late, _), _ = rates(one, 0, 0.014)
    assert early.value - late.value == pytest.approx(0.004, rel=0.2)
    (open_, _), _ = rates(one, 0, 0.012, 0.002)
    assert open_.sigma > 0.002 > late.sigma
    assert thrust(one, VEHICLE, 0.012, 0.002)[0][0].sigma > 0.002 > thrust(one, VEHICLE, 0.012)[0][0].sigma


def test_lags_are_not_told_without_the_delay():
    """Neither roll nor pitch is commanded; yaw and thrust are, and tell the sum of lag and delay alone."""
    one = record(seconds=10.0)
    still = replace(one, rates=one.rates * (0.0, 0.0, 1.0), gyro=one.gyro * (0.0, 0.0, 1.0))
    found = {each.key: each for each in identify(still, VEHICLE)[0]}
    for key in ("actuation.rate_lag[2]", "actuation.thrust_lag"):
        assert found[key].reason == "it depends on the delay, which is not identified"
    assert not found["actuation.rate_gain[2]"].reason


def test_parts_of_a_record_do_not_begin_settled():
    """The scatter of the parts is the noise's, though the vehicle turns where each begins."""
    one = record(size=4.0, seconds=10.0)
    (lag, _, delay), _ = rates(one, 0)
    assert lag.sigma < 3e-4 and delay.sigma < 3e-4 and abs(delay.value - DELAY) < 5e-4


def test_a_hover_tells_nothing_and_says_so():
    found, _ = identify(record(size=0.05, seconds=10.0), VEHICLE)
    assert all(one.reason for one in found if one.key.startswith("actuation"))
    assert "too small" in found[0].reason
    assert "not identifiable from roll or pitch" in next(one.reason for one in found if one.key == "actuation.delay")


@pytest.mark.slow
def test_a_loop_that_rings_is_none_of_first_order():
    found, answers = identify(record(oscillation=15.0, seconds=10.0), VEHICLE)
    assert "explains" in found[0].reason and answers[0].explained < 0.9


@pytest.mark.slow
def test_rotors_are_identified_from_their_speeds():
    n, tau, hover = 9000, 0.04, 1200.0
    t, scale = PERIOD * np.arange(n), 1.07
    speeds = hover + np.stack([150 * np.sin(2 * np.pi * f * t) + 40 * np.sin(9 * t) for f in (0.7, 1.1, 1.6, 2.3)], axis=1)
    vehicle, share = load_vehicle("snapdragon"), PERIOD / FINE / tau
    held = np.repeat(speeds, FINE, axis=0)
    omega = lfilter([share], [1.0, share - 1.0], held, axis=0, zi=(1.0 - share) * speeds[:1])[0]
    felt = scale * vehicle.thrust_coefficient * np.sum(omega**2, axis=1).reshape(n, FINE).mean(axis=1) / vehicle.mass
    v = 0.5 * np.sin(3.0 * t)[:, None] * np.ones(3)
    noise = 0.3 * np.random.default_rng(4).standard_normal((n, 3))
    accel = np.stack([0 * felt, 0 * felt, felt], axis=1) + noise - 0.2 * v
    found = {one.key: one for one in identify(Record(t + PERIOD, 0 * v, accel, v, t, rotor_speeds=speeds), vehicle)[0]}
    assert found["motor_time_constant"].value == pytest.approx(tau, rel=0.03)
    assert found["thrust_coefficient"].value == pytest.approx(scale * vehicle.thrust_coefficient, rel=0.01)


@pytest.mark.parametrize("true, words", [
    ({"delay": 0.14, "lags": (0.03, 0.04, 0.11)}, "the delay is at the bound of its fit, 0.1 s"),
    ({"lags": (0.7, 0.04, 0.11), "size": 4.0}, "the lag is at the bound of its fit, 0.5 s"),
    ({"gains": (0.17, 0.9, 1.05)}, "the gain is at the bound of its fit, 0.2")])
def test_a_fit_that_ends_at_a_bound_is_none(true, words):
    assert [one.reason for one in rates(record(seconds=12.0, **true), 0)[0]] == [words] * 3


def test_why_the_delay_is_not_identified_is_said():
    found, _ = identify(record(seconds=12.0, delay=0.14), VEHICLE)
    assert "the delay is at the bound of its fit, 0.1 s" in next(one.reason for one in found if one.key == "actuation.delay")


def test_a_flight_without_commands_is_refused():
    with pytest.raises(PerchError, match="no imu/data_raw"):
        record_of(Flight({}))


def hover(gyro=0.0, thrust=9.81):
    """A flight of 10 s whose gyroscope, and whose command, have a value of their own at 5 s."""
    t, zero, C = 0.01 * np.arange(1000), (0.0, 0.0, 0.0), np.zeros((6, 6))
    own = np.arange(1000) == 500
    return Flight({
        "odometry": [(s, OdometryState(round(1e9 * s), (0.0, 0.0, float(s > 0.5)), (0.0, 0.0, 0.0, 1.0), zero, zero, C, C)) for s in t],
        "imu/data_raw": [(s, ImuSample(round(1e9 * s), (gyro if one else 0.0, 0.0, 0.0), (0.0, 0.0, 9.81))) for s, one in zip(t, own)],
        "rates_thrust_command": [(s, RatesThrust(round(1e9 * s), True, zero, thrust if one else 9.81)) for s, one in zip(t, own)]})


@pytest.mark.parametrize("wrong, words", [({"gyro": np.nan}, "gyro is not finite in 1 of"), ({"thrust": np.inf}, "thrust is not finite in 1 of")])
def test_a_flight_with_values_that_are_not_finite_is_refused(wrong, words):
    assert record_of(hover()).t.size > 500
    with pytest.raises(PerchError, match=words):
        record_of(hover(**wrong))


@pytest.mark.slow
def test_the_program_flies_and_writes_a_vehicle_file(tmp_path, monkeypatch, capsys):
    """On a vehicle whose loop is 1.3 times as slow as its file says, and 4 % heavier."""
    (tmp_path / "slow.yaml").write_text("name: slow\nextends: surface_90\ndisturbance: {loop_lag_factor: 1.3, mass_factor: 1.04}\n")
    monkeypatch.setattr(command.flight, "ROUNDS", 1)
    monkeypatch.setattr(command.flight, "MOVES", command.flight.MOVES[:4])
    monkeypatch.setattr("sys.argv", ["identify.py", "--vehicle", "snapdragon_rates", "--scenario", str(tmp_path / "slow.yaml"), "--out",
                                     str(tmp_path)])
    assert command.main() in (0, 1), capsys.readouterr().err  # drag needs a longer flight
    written, nominal = load_vehicle(tmp_path / "vehicle.yaml").actuation, VEHICLE.actuation
    wanted = [1.3 * lag + nominal.delay for lag in (*nominal.rate_lag, nominal.thrust_lag)]  # the rotors' own time counts as delay
    assert [lag + written.delay for lag in (*written.rate_lag, written.thrust_lag)] == pytest.approx(wanted, rel=0.08)
    assert written.thrust_gain == pytest.approx(1 / 1.04, abs=0.015) and written.rate_gain == pytest.approx((1.0,) * 3, abs=0.02)
    assert (tmp_path / "identify.png").stat().st_size > 20_000
    assert "+-" in (tmp_path / "vehicle.yaml").read_text() and config.find("vehicles", tmp_path / "vehicle.yaml")
    assert replace(load_vehicle(tmp_path / "vehicle.yaml"), name="x", drag=VEHICLE.drag, actuation=nominal) == replace(VEHICLE, name="x")


@pytest.mark.parametrize("arguments, words", [(["--vehicle", "nothing"], "nothing: unknown"),
                                              (["--vehicle", "snapdragon", "--recording", "/no/file"], "no such recording")])
def test_mistakes_are_one_line(arguments, words, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["identify.py", *arguments])
    assert command.main() == 2
    line = capsys.readouterr().err
    assert words in line and line.count("\n") == 1


@pytest.mark.slow
def test_the_report_shows_the_loop_where_rates_are_taken(monkeypatch):
    monkeypatch.setattr(responses, "perch_window", lambda flight: (1.0, 2.0))
    one = record(seconds=3.0)
    sent = [(float(t), RatesThrust(0, True, tuple(map(float, w)), float(T))) for t, w, T in zip(one.command_t, one.rates, one.thrust)]
    imu = [(float(t), ImuSample(0, tuple(map(float, w)), tuple(map(float, f)))) for t, w, f in zip(one.t, one.gyro, one.accel)]
    drawn = responses.inner_loop_figure(Flight({"rates_thrust_command": sent, "imu/data_raw": imu}), VEHICLE)
    assert drawn is not None and len(drawn.axes) == 8 and all(axes.lines for axes in drawn.axes)
    assert responses.inner_loop_figure(Flight({"imu/data_raw": imu}), VEHICLE) is None


# -- the battery: one flight at each voltage -------------------------------------------------------------------------------

VOLTAGES = (16.4, 15.6, 14.8, 14.0)


def gains(*factors, sigma=0.004, refused=""):
    return [Estimate("actuation.thrust_gain", factor, sigma, "", refused) for factor in factors]


@pytest.mark.parametrize("flown", [0.0, 1.5])
def test_the_exponent_of_the_battery_is_found(flown):
    noise = 1.0 + 0.004 * np.random.default_rng(1).standard_normal(4)
    told = gains(*(0.97 * noise * (np.array(VOLTAGES) / 16.4) ** (1.7 - flown)))
    one = battery(VOLTAGES, told, flown)
    assert not one.reason and abs(one.value - 1.7) < 3.0 * one.sigma and one.sigma < 0.1


@pytest.mark.parametrize("voltages, factors, sigma, words", [
    (VOLTAGES, (1.0, 0.93, 0.99, 0.7), 0.004, "misses the thrust"), ((16.4, 16.0), (1.0, 0.95), 0.004, "are 2 % apart"),
    ((16.4, 16.4), (1.0, 1.0), 0.004, "apart"), (VOLTAGES, (1.0, 0.99, 1.02, 0.995), 0.004, "exponent of"),
    (VOLTAGES, (1.0, 0.9, 0.81, 0.73), 0.2, "standard deviation")])
def test_a_battery_curve_that_does_not_fit_is_refused(voltages, factors, sigma, words):
    assert words in battery(voltages, gains(*factors, sigma=sigma)).reason


def test_a_battery_curve_that_does_not_fit_is_one_line_and_writes_nothing(tmp_path, monkeypatch, capsys):
    told = iter([gains(factor) for factor in (1.0, 1.0, 0.93, 0.99, 0.7)])  # the first flight tells all else, too
    monkeypatch.setattr(command, "flights", lambda *_: [None] * 4)
    monkeypatch.setattr(command, "record_of", lambda flight: flight)
    monkeypatch.setattr(command, "identify", lambda *_: (next(told), []))
    out = tmp_path / "identify"
    monkeypatch.setattr("sys.argv", ["identify.py", "--vehicle", "snapdragon_rates", "--out", str(out), "--voltage", *map(str, VOLTAGES)])
    assert command.main() == 2 and not out.exists()
    line = capsys.readouterr().err
    assert "no curve of the battery fits: a power of the voltage misses the thrust" in line and line.count("\n") == 1


def test_a_gain_that_is_not_told_leaves_the_battery_untold():
    assert battery(VOLTAGES, gains(1.0, 0.9, 0.81, 0.73, refused="too small")).reason == "too small"


def test_the_battery_is_written_where_the_vehicle_file_has_it(tmp_path):
    found = [Estimate("actuation.thrust_gain", 0.98, 0.01, ""), battery(VOLTAGES, gains(*((np.array(VOLTAGES) / 16.4) ** 1.7)))]
    (tmp_path / "one.yaml").write_text(command.vehicle_file_text(found, VEHICLE, "snapdragon_rates", "one", "a test", VOLTAGES))
    assert load_vehicle(tmp_path / "one.yaml").actuation.battery == Battery(reference=16.4, exponent=1.7, range=(14.0, 16.4))


@pytest.mark.parametrize("arguments, words", [
    (["--voltage", "16"], "two or more"), (["--voltage", "16", "-3"], "two or more"), (["--voltage", "16", "14"], "has none"),
    (["--voltage", "16", "14", "--recording", "/no/file"], "1 files, and 2 voltages")])
def test_voltages_that_are_none_are_one_line(arguments, words, monkeypatch, capsys):
    monkeypatch.setattr("sys.argv", ["identify.py", "--vehicle", "snapdragon_rates", *arguments])
    assert command.main() == 2
    line = capsys.readouterr().err
    assert words in line and line.count("\n") == 1
