"""Watchdog and pilot's takeover on Betaflight's own firmware, in simulated time: commands stop in each phase of a perch.

A perch on `surface_90` (modelled VIO and tags) is flown through the firmware. Commands go to the process that holds the link
(`LinkSupervisor`) and from there over MSP to the firmware, whose self-level mode levels the simulated body. They stop for 50 ms
to 5 s, or for good: the node is killed or hangs. In further runs, a body in free air, without a wall, starts tilted and rotating.
Times are relative to the last command that reached the supervisor. The firmware is built on first use.
"""

from __future__ import annotations

from contextlib import closing
from dataclasses import dataclass, replace

import numpy as np

from closed_loop.supervised_loop import Body, SupervisedLoop
from harness import Figure, figure

from perch_autopilot.firmware import ensure_program
from perch_autopilot.watchdog import OFF, Mode
from perch_core.vehicle import load_vehicle
from perch_eval.goal import goal_of
from perch_eval.in_process import Loop, arrange
from perch_eval.metrics import tilt_degrees
from perch_sim.scenario import load_scenario

SEEDS = "1"
SCENARIO = replace(load_scenario("surface_90"), vehicle="betaflight")
LEVEL = 10.0                              # tilt that counts as level [deg]
PHASES = {"take-off": ("take_off", 0.6), "hover": ("searching", 0.3), "way to the wall": ("tracking", 0.5),
          "turn begins": ("contact", -0.35), "turn": ("contact", -0.25), "turn, late": ("contact", -0.15), "perched": ("perched", 0.3)}
"""Name -> phase of the mission, time after its beginning [s]; `contact`: time relative to the first touch."""
GAPS = (0.05, 0.2, 0.5, 1.0, 5.0)         # commands stop for so long [s]; then they go on
TILTED = ((30.0, 2.0), (60.0, 4.0), (90.0, 0.0), (85.0, 6.5))
"""Tilt [deg] and rate [rad/s] of a body in free air at the last commands, which demand that rate."""
AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.6, 0.8, 0.0))
"""Axes of its rotation: roll, pitch, and between them."""
PERCH_TIME_MAX = 60.0                     # of the undisturbed flight [s]
OBSERVATION_TIME = 6.0                    # after they have stopped [s]


@dataclass(frozen=True)
class Stop:
    """Result of stopped commands; times are from the last command [s].

    inf: never; nan: not before the next command or a touch, or with the motors off before, which leaves it open. A vehicle that
    touches something before it is level was not levelled in time: inf.

    Attributes:
        tilt: of the body at the last command [deg].
        max_tilt: largest tilt after it [deg].
        commanded: time until the autopilot is commanded to level, or off.
        levelled: time until the body is level, and stays level.
        down: time until a descent is commanded, or motors are off.
        held: time for which the last command was still sent.
    """

    tilt: float
    max_tilt: float
    commanded: float
    levelled: float
    down: float
    held: float


def start_flight() -> tuple[Loop, SupervisedLoop, list[float]]:
    """Return a flight before its first step, with its goal sent, its autopilot, and the growing list of times of touches [s]."""
    loop, touched = arrange(SCENARIO, 1), []
    simulation = loop.vehicle.simulation
    simulation.loop.close()
    simulation.loop = supervised = SupervisedLoop(load_vehicle(SCENARIO.vehicle))
    loop.vehicle.contact.receivers.append(lambda event: touched.append(loop.time))
    loop.send("mission", goal_of(SCENARIO))
    return loop, supervised, touched


def phase_times() -> dict[str, float]:
    """Return the times of `PHASES` in the undisturbed flight [s]."""
    loop, _, touched = start_flight()
    with closing(loop):
        while loop.time < PERCH_TIME_MAX and not any(phase == "perched" for _, phase, _ in loop.trace.phases):
            loop.step()
    at = {phase: time for time, phase, _ in reversed(loop.trace.phases)}
    at["contact"] = min(time for time in touched if time > at["tracking"])
    return {name: at[phase] + offset for name, (phase, offset) in PHASES.items()}


def stopped(at: float, gap: float | None, kill: bool = False) -> Stop:
    """Fly, and stop the commands.

    Args:
        at: start of the gap [s].
        gap: its duration [s]; None: for good.
        kill: the node is killed; otherwise it sends nothing.
    """
    loop, supervised, touched = start_flight()
    with closing(loop):
        while loop.time < at:
            loop.step()
        supervised.kill() if kill else setattr(supervised, "cut", True)
        last, touched[:] = supervised.last_command, []
        flying = loop.vehicle.simulation.plant.rotor_speed.min() > 0.0
        until, rows = last + min(gap or OBSERVATION_TIME, OBSERVATION_TIME), []
        while loop.time < until and not touched:
            rows.append((loop.time - last, float(tilt_degrees(loop.vehicle.simulation.state.q_WB)), supervised.watchdog.mode))
            loop.step()
    t, tilt = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    modes = [row[2] for row in rows]

    missing = np.nan if touched or (gap or np.inf) < OBSERVATION_TIME else np.inf

    def first(which: set[Mode]) -> float:
        return next((float(time) for time, mode in zip(t, modes) if mode in which), missing)

    followed = [float(time) for time, mode in zip(t, modes) if mode is Mode.FOLLOWING]
    return Stop(tilt[0], tilt.max(), first({Mode.LEVEL, Mode.DESCENDING, Mode.DISARMED}),
                level_from(t, tilt) if flying else np.nan, first({Mode.DESCENDING, Mode.DISARMED}),
                max(followed, default=0.0))


def level_from(t: np.ndarray, tilt: np.ndarray) -> float:
    """Return the time from which on the body is level; inf: it is not at the end. `tilt` [deg] at times t [s], shapes (n,)."""
    above = np.flatnonzero(tilt > LEVEL)
    after = 0 if above.size == 0 else above[-1] + 1
    return float(t[after]) if after < len(t) else np.inf


def levelled(vehicle: str, axis: tuple[float, float, float], tilt: float, rate: float) -> float:
    """Return the time from the last command until a body in free air, tilted and rotating about an axis in B, is level [s]."""
    body = Body(load_vehicle(vehicle))
    with closing(body.loop):
        body.hover()
        body.found(np.array(axis), tilt, rate)
        last, body.loop.cut, above = body.loop.last_command, True, 0.0
        while body.time < last + 1.5:
            body.step(True)
            above = body.time - last if body.tilt > LEVEL else above
        return above


def held_without_link() -> float:
    """Return how long after the link is cut the firmware holds the last commanded rate, at most 1.5 s [s]."""
    body = Body(load_vehicle(SCENARIO.vehicle))
    with closing(body.loop):
        body.hover()
        body.found(np.array([1.0, 0.0, 0.0]), 0.0, 2.0)
        begin, body.loop.severed = body.time, True
        while body.plant.w[0] > 1.0 and body.time < begin + 1.5:
            body.step(True, (2.0, 0.0, 0.0))
        return body.time - begin


def taken_over(at: float) -> float:
    """Return the time from the pilot's takeover, with the arming switch off, to the first cycle with motors stopped [s]."""
    loop, supervised, _ = start_flight()
    with closing(loop):
        while loop.time < at:
            loop.step()
        supervised.radio[4], supervised.radio[6], begin = OFF, OFF, loop.time
        while np.any(supervised.aimed):
            loop.step()
            if loop.time > begin + 1.0:
                return float("inf")
        return loop.time - begin


def figures(quick: bool) -> list[Figure]:
    """Measure every phase with every gap; `quick`: only with the node killed."""
    ensure_program()
    found, out = {}, []
    print(f"{'phase':16s} {'stop':>8s} {'tilt':>5s} {'max':>5s} {'sent':>6s} {'level':>6s} {'down':>6s} {'held':>6s}   [deg], [s]")
    for name, at in (when := phase_times()).items():
        for gap, kill in ((None, True), *(() if quick else ((None, False), *((gap, False) for gap in GAPS)))):
            one = found[name, gap, kill] = stopped(at, gap, kill)
            stop = "killed" if kill else "hung" if gap is None else f"{gap:g} s"
            times = " ".join(f"{value:6.3f}" for value in (one.commanded, one.levelled, one.down, one.held))
            print(f"{name:16s} {stop:>8s} {one.tilt:5.0f} {one.max_tilt:5.0f} {times}", flush=True)
    flying = {key: one for key, one in found.items() if key[0] != "perched"}
    out.append(figure("last command held", "s", [one.held for one in flying.values()], 0.05, "max <="))
    long = [one for (_, gap, _), one in flying.items() if gap is None or gap > 0.3]
    out.append(figure(f"level within {LEVEL:g} deg", "s", [one.levelled for one in long], 0.3, "max <="))
    for tilt, rate in TILTED:
        times = [levelled(vehicle, axis, tilt, rate)
                 for vehicle in (SCENARIO.vehicle, "rpg_betaflight") for axis in (AXES[1:2] if quick else AXES)]
        print(f"{tilt:g} deg, {rate:g} rad/s: level after", *(f"{time:.3f}" for time in times), "s", flush=True)
        out.append(figure(f"level within {LEVEL:g} deg, from {tilt:g} deg and {rate:g} rad/s", "s", times, 0.3, "max <="))
    out.append(figure("descent or motors off", "s", [one.down for one in long if not np.isnan(one.down)], 1.0, "max <="))
    out.append(figure("last command held by the firmware, link cut", "s", [held_without_link()], 0.05, "max <="))
    out.append(figure("pilot takes over", "s", [taken_over(at) for name, at in when.items() if name != "perched"], 0.05, "max <="))
    return out
