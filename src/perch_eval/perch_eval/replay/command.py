"""Show a recorded flight as an animation or a stroboscopic picture, and as plots."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from perch_core.errors import PerchError
from perch_core.vehicle import load_vehicle
from perch_eval import plots
from perch_eval.arguments import command, command_parser, count, output_file, output_folder
from perch_eval.flight_view import FlightView
from perch_eval.recorded import identify_vehicle, read_flight, read_report
from perch_eval.replay.animation import Scene, write_animation
from perch_eval.replay.stroboscope import stroboscope

BEFORE, AFTER = 1.0, 1.0  # shown around the perch [s]
EXAMPLES = """examples:
  python3 scripts/replay.py out/flight.mcap                       animation of the perch, out/flight.gif
  python3 scripts/replay.py out/flight.mcap --speed 0.25          in slow motion
  python3 scripts/replay.py out/flight.mcap --from 1 --to 9 --out all.mp4
  python3 scripts/replay.py out/flight.mcap --out perch.png       the vehicle at ten instants of the perch, in one picture
  python3 scripts/replay.py out/flight.mcap --plots plots         and the plots as PNG

exit code: 0 written, 2 invalid input (no such recording, nothing in it)"""


def parser() -> argparse.ArgumentParser:
    """The command line."""
    out = command_parser("replay.py", __doc__, EXAMPLES)
    out.add_argument("flight", type=Path, metavar="FLIGHT.mcap", help="recording (demo.py, recorder, a campaign's kept flight), or a folder with flight.mcap")
    out.add_argument("--out", type=Path, metavar="FILE", help="animation, .gif or .mp4, or a stroboscopic picture, .png (default: FLIGHT.gif)")
    out.add_argument("--plots", type=Path, metavar="DIR", help="also write the plots here, as PNG")
    out.add_argument("--from", dest="start", type=float, metavar="S", help=f"begin (default: {BEFORE:g} s before the perch)")
    out.add_argument("--to", dest="end", type=float, metavar="S", help=f"end (default: {AFTER:g} s after the contact)")
    out.add_argument("--fps", type=float, default=15.0, help="frames per second (default: %(default)s)")
    out.add_argument("--speed", type=float, default=1.0, help="1: real time, 0.25: slow motion (default: %(default)s)")
    out.add_argument("--instants", type=count, default=10, help="instants in a stroboscopic picture (default: %(default)s)")
    out.add_argument("--vehicle", default="", help="vehicle that is drawn (default: the one that flew)")
    out.add_argument("--namespace", default="", help="namespace of the vehicle, where several were recorded")
    return out


def _show(args: argparse.Namespace) -> int:
    for name in ("fps", "speed"):
        if not 0.0 < getattr(args, name) < np.inf:
            raise PerchError(f"--{name} {getattr(args, name):g} is not a number > 0")
    if args.out and args.out.suffix.lower() not in (".gif", ".mp4", ".png"):
        raise PerchError(f"{args.out}: the ending is none of .gif, .mp4 and .png")
    if args.plots:
        output_folder(args.plots, "--plots")
    flight = read_flight(args.flight, args.namespace)
    path = args.out or Path(flight.source).with_suffix(".gif")
    flight.known_states("ground_truth/odometry")
    vehicle = identify_vehicle(flight, {} if args.vehicle else read_report(flight), args.vehicle)
    view = FlightView.from_flight(flight, vehicle or load_vehicle("snapdragon"))
    if path.suffix.lower() == ".png":
        start, end = span(view, args.start, args.end, 0.0, 0.0)
        with output_file(path) as draft:
            stroboscope(view, start, end, args.instants).savefig(draft, dpi=110)
        print(f"picture: {path}")
    else:
        start, end = span(view, args.start, args.end)
        step = args.speed / args.fps
        times = start + step * np.arange(max(1, round((end - start) / step)))
        with output_file(path) as draft:
            print(f"{len(times)} frames, {start:.2f} to {end:.2f} s", flush=True)
            write_animation(Scene(view, start, end), times, args.fps, draft)
        print(f"animation: {path}")
    if args.plots:
        write_plots(view, args.plots, thrust=vehicle is not None)
        print(f"plots: {args.plots}")
    return 0


def span(view: FlightView, start: float | None, end: float | None, before: float = BEFORE, after: float = AFTER) -> tuple[float, float]:
    """Return the time span to show [s]: the given one, or else the perch with margins, or the whole flight if it has no perch.

    Raises:
        PerchError: the span does not overlap the flight.
    """
    perch, (first, last) = view.around(before, after), (float(view.truth.t[0]), float(view.truth.t[-1]))
    begin, finish = perch[0] if start is None else start, perch[1] if end is None else end
    if not (begin < finish and begin < last and finish > first):
        raise PerchError(f"--from {begin:g} --to {finish:g}: the flight lasts from {first:.2f} to {last:.2f} s")
    return max(begin, first), min(finish, last)


def write_plots(view: FlightView, folder: Path, thrust: bool) -> None:
    """Write the figures of the flight's report as PNG files; `thrust`: also that of the thrust, which requires the vehicle."""
    figures: dict[str, Callable[[FlightView], Figure | None]] = {
        "tracking": plots.tracking_figure, "path": plots.path_figure, "rates": plots.rates_figure,
        "estimation_error": plots.error_figure, **({"thrust": plots.thrust_figure} if thrust else {})}
    for name, draw in figures.items():
        if figure := draw(view):
            figure.savefig(folder / f"{name}.png", dpi=95)


main = command(parser, _show)
