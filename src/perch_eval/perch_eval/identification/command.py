"""The program `identify`."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from perch_core import config
from perch_core.errors import PerchError
from perch_core.vehicle import load_vehicle
from perch_eval.identification import flight, page
from perch_eval.identification.fit import identify
from perch_eval.identification.record import record_of
from perch_sim.scenario import load_scenario

EXAMPLES = """examples:
  python3 scripts/identify.py --vehicle snapdragon_rates                    fly in the simulator, and identify
  python3 scripts/identify.py --vehicle snapdragon_rates --scenario x.yaml  the same on a vehicle that differs (disturbance:)
  python3 scripts/identify.py --vehicle betaflight_unidentified --name betaflight   through Betaflight's firmware: config/vehicles/betaflight.yaml
  python3 scripts/identify.py --vehicle mine.yaml --recording flight.mcap   identify from a recorded flight: hover, short moves, turns

files: vehicle.yaml (extends the vehicle, with standard deviations), identify.png
exit code: 0 everything is told, 1 something is not (the reasons beside it), 2 wrong arguments, or a flight that tells nothing"""


def command_line() -> argparse.ArgumentParser:
    """The options."""
    parser = argparse.ArgumentParser(prog="identify.py", description="Identify lags, gains, thrust and drag of a vehicle from a flight.",
                                     epilog=EXAMPLES, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--vehicle", required=True, help="vehicle file as it is known so far, a name in config/vehicles or a file")
    parser.add_argument("--recording", type=Path, help="MCAP file of a flight (default: fly in the simulator)")
    parser.add_argument("--scenario", default="surface_90", help="where to fly, and how the real vehicle differs (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the simulated flight (default: %(default)s)")
    parser.add_argument("--name", default="", help="name of the identified vehicle (default: that of the vehicle with _identified)")
    parser.add_argument("--out", type=Path, default=Path("out/identify"), help="folder for the results (default: %(default)s)")
    return parser


def main() -> int:
    """Fly or read, fit, write, tell."""
    arguments = command_line().parse_args()
    try:
        vehicle = load_vehicle(arguments.vehicle)
        flown_as = str(arguments.recording or f"simulated flight, scenario {arguments.scenario}, seed {arguments.seed}")
        if arguments.recording is None:
            flown = flight.fly(load_scenario(arguments.scenario), arguments.vehicle, arguments.seed)
        else:
            if not arguments.recording.is_file():
                raise PerchError(f"{arguments.recording}: no such file")
            from perch_eval.ros.recorded_flight import RecordedFlight

            flown = RecordedFlight(arguments.recording)
        found, answers = identify(record_of(flown), vehicle)
        arguments.out.mkdir(parents=True, exist_ok=True)
        is_file = arguments.vehicle.endswith((".yaml", ".yml"))
        base = config.find("vehicles", arguments.vehicle).resolve() if is_file else arguments.vehicle
        name = arguments.name or f"{vehicle.name}_identified"
        (arguments.out / "vehicle.yaml").write_text(page.entries(found, vehicle, str(base), name, flown_as))
        page.draw(arguments.out / "identify.png", found, answers, f"{vehicle.name}: {flown_as}")
    except PerchError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error.filename or arguments.out}: {error.strerror}", file=sys.stderr)
        return 2
    print("\n".join(map(str, found)))
    print(f"{'thrust against battery voltage':32s} not identified: no recording holds battery voltage and thrust together")
    print(f"written: {arguments.out / 'vehicle.yaml'}, {arguments.out / 'identify.png'}")
    return 1 if any(one.refused for one in found) else 0
