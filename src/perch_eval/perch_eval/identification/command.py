"""Identify lags, gains, thrust and drag of a vehicle from a flight; write a vehicle file and a page of plots."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from perch_core import config
from perch_core.errors import PerchError
from perch_core.vehicle import Vehicle, load_vehicle
from perch_eval.arguments import command, command_parser
from perch_eval.flight import Flight
from perch_eval.identification import flight
from perch_eval.identification.fit import Estimate, battery, identify
from perch_eval.identification.flight import record_of
from perch_eval.identification.responses import Response, response_figure
from perch_sim.scenario import load_scenario

GENTLE_STRETCH = 1.4  # factor of the duration of moves at other voltages: they need half the acceleration
EXAMPLES = """examples:
  python3 scripts/identify.py --vehicle snapdragon_rates                    fly in the simulator, and identify
  python3 scripts/identify.py --vehicle snapdragon_rates --scenario x.yaml  the same on a vehicle that differs (disturbance:)
  python3 scripts/identify.py --vehicle betaflight_unidentified --name betaflight   through Betaflight's firmware: config/vehicles/betaflight.yaml
  python3 scripts/identify.py --vehicle mine.yaml --recording flight.mcap   identify from a recorded flight: hover, short moves, turns
  python3 scripts/identify.py --vehicle mine.yaml --recording full.mcap half.mcap low.mcap --voltage 16.4 15.2 14.0   with the battery's curve

files: vehicle.yaml (extends the vehicle, with standard deviations), identify.png
exit code: 0 all values identified, 1 some are not identifiable (with the reasons), 2 wrong arguments, an unusable flight,
or no fitting battery curve"""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    out = command_parser("identify.py", "Identify lags, gains, thrust and drag of a vehicle from a flight.", EXAMPLES)
    out.add_argument("--vehicle", required=True, help="vehicle file as it is known so far, a name in config/vehicles or a file")
    out.add_argument("--recording", type=Path, nargs="+", default=[], help="MCAP file of a flight (default: fly in the simulator)")
    out.add_argument("--voltage", type=float, nargs="+", default=[], metavar="V",
                     help="the battery's in each flight, two or more: thrust against voltage; the first is that of the thrust curve")
    out.add_argument("--scenario", default="surface_90", help="where to fly, and how the real vehicle differs (default: %(default)s)")
    out.add_argument("--seed", type=int, default=1, help="seed of the simulated flight (default: %(default)s)")
    out.add_argument("--name", default="", help="name of the identified vehicle (default: that of the vehicle with _identified)")
    out.add_argument("--out", type=Path, default=Path("out/identify"), help="folder for the results (default: %(default)s)")
    return out


def flights(arguments: argparse.Namespace, vehicle: Vehicle) -> Sequence[Flight]:
    """Return the recorded flights, or fly in the simulator: one flight, or one at each voltage.

    Raises:
        PerchError: a recording cannot be read, or the voltages do not fit the vehicle or the recordings.
    """
    voltages = arguments.voltage
    if voltages:
        if len(voltages) < 2 or not all(0.0 < one < 100.0 for one in voltages):
            raise PerchError(f"--voltage: needs two or more values between 0 and 100 V, not {voltages}")
        if vehicle.actuation.type != "rates_and_thrust":
            raise PerchError(f"--voltage: {arguments.vehicle} takes {vehicle.actuation.type}, not rates_and_thrust")
        if vehicle.actuation.battery.reference not in (0.0, voltages[0]):
            raise PerchError(f"--voltage: the first must be the {vehicle.actuation.battery.reference:g} V of {arguments.vehicle}'s curve so far")
    if arguments.recording:
        if len(arguments.recording) != max(len(voltages), 1):
            raise PerchError(f"--recording: {len(arguments.recording)} files, and {len(voltages)} voltages (--voltage)")
        from perch_eval.recorded import read_flight

        return [read_flight(file) for file in arguments.recording]
    if voltages and not vehicle.actuation.firmware:
        raise PerchError(f"--voltage: the simulated battery drives the motors of a firmware, and {arguments.vehicle} has none")
    scenario = load_scenario(arguments.scenario)
    flown = [flight.fly(scenario, arguments.vehicle, arguments.seed)]
    for one in voltages[1:]:
        at = replace(scenario, disturbance=replace(scenario.disturbance, voltage_factor=one / voltages[0]))
        flown.append(flight.fly(at, arguments.vehicle, arguments.seed, GENTLE_STRETCH))
    return flown


def _identify(arguments: argparse.Namespace) -> int:
    """Fly or read the flights, identify, write the files, and print the values."""
    vehicle = load_vehicle(arguments.vehicle)
    flown_as = ", ".join(map(str, arguments.recording)) or f"simulated flight, scenario {arguments.scenario}, seed {arguments.seed}"
    flown = flights(arguments, vehicle)
    estimates, responses = identify(record_of(flown[0]), vehicle)
    if arguments.voltage:
        gains = [next(one for one in identify(record_of(one), vehicle)[0] if one.key == "actuation.thrust_gain") for one in flown]
        curve = vehicle.actuation.battery
        estimates.append(battery(arguments.voltage, gains, curve.exponent if curve.reference else 0.0))
        if estimates[-1].reason:
            raise PerchError(f"--voltage: no curve of the battery fits: {estimates[-1].reason}")
    arguments.out.mkdir(parents=True, exist_ok=True)
    is_file = arguments.vehicle.endswith((".yaml", ".yml"))
    base = config.find("vehicles", arguments.vehicle).resolve() if is_file else arguments.vehicle
    name = arguments.name or f"{vehicle.name}_identified"
    (arguments.out / "vehicle.yaml").write_text(vehicle_file_text(estimates, vehicle, str(base), name, flown_as, arguments.voltage))
    draw(arguments.out / "identify.png", estimates, responses, f"{vehicle.name}: {flown_as}")
    print("\n".join(map(str, estimates)))
    if not arguments.voltage:
        print(f"{'actuation.battery':32s} not identified: needs flights at two or more voltages (--voltage)")
    print(f"written: {arguments.out / 'vehicle.yaml'}, {arguments.out / 'identify.png'}")
    return 1 if any(one.reason for one in estimates) else 0


def vehicle_file_text(estimates: Sequence[Estimate], vehicle: Vehicle, base: str, name: str, flight: str,
                      voltages: Sequence[float] = ()) -> str:
    """Return a vehicle file that extends `base` by the identified values; values that were refused get a comment with the reason.

    Args:
        estimates: identified values.
        vehicle: vehicle as known so far.
        base: name or file of that vehicle.
        name: name of the identified vehicle.
        flight: description of the flight.
        voltages: voltages of the flights [V]; the first is that of the thrust curve.
    """
    lines: list[str] = []
    for key in dict.fromkeys(one.key.split("[")[0] for one in estimates):
        group = [one for one in estimates if one.key.split("[")[0] == key]
        owner = vehicle.actuation if key.startswith("actuation.") else vehicle
        field = key.split(".")[-1]
        if key == "actuation.battery.exponent" and not group[0].reason:
            text = f"{{reference: {voltages[0]:g}, exponent: {group[0].value:.4g}, range: [{min(voltages):g}, {max(voltages):g}]}}"
            lines.append(f"  battery: {text}  # exponent +- {group[0].sigma:.2g}")
        old = getattr(owner, field, None)
        if old is None:
            continue
        new = [old[i] if one.reason else one.value for i, one in enumerate(group)] if isinstance(old, tuple) else group[0].value
        identified = not all(one.reason for one in group)
        axes = [f"{'xyz'[i]} " if len(group) > 1 else "" for i in range(len(group))]
        sigmas = "; ".join(f"{axis}+- {one.sigma:.2g} {one.unit}".rstrip() for axis, one in zip(axes, group) if not one.reason)
        text = f"[{', '.join(f'{x:.4g}' for x in new)}]" if isinstance(new, list) else f"{new:.5g}"
        indent = "  " if key.startswith("actuation.") else ""
        lines += [f"{indent}# {field}: {axis}not identified: {one.reason}" for axis, one in zip(axes, group) if one.reason]
        if identified:
            lines.append(f"{indent}{field}: {text}".ljust(45) + f"# {sigmas}")
    outer, inner = [line for line in lines if not line.startswith("  ")], [line for line in lines if line.startswith("  ")]
    head = [f"# Identified by scripts/identify.py, with standard deviations. Of: {flight}", f"extends: {base}", f"name: {name}"]
    return "\n".join([*head, *outer, *(["actuation:", f"  type: {vehicle.actuation.type}", *inner] if inner else [])]) + "\n"


def draw(file: Path, estimates: Sequence[Estimate], responses: Sequence[Response], title: str) -> None:
    """Write a figure of the responses with the identified values below."""
    figure = response_figure([replace(response, t=response.t - response.t[0]) for response in responses])
    figure.suptitle(title)
    figure.supxlabel("\n".join(map(str, estimates)), family="monospace", fontsize=8, x=0.02, ha="left")
    figure.savefig(file, dpi=95)


main = command(parser, _identify)
