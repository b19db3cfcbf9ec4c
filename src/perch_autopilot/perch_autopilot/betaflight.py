"""Component of the node `betaflight`: sends body rates and thrust to a flight controller over MSP, reads its IMU and state."""

from __future__ import annotations

import time
from dataclasses import dataclass

from perch_core.component import Component, Diagnostics, Input, LogLine, Output, Timer
from perch_core.config import quantity, text
from perch_core.values import NANOSECONDS, Command, ControllerCommand, ImuSample, RatesThrust, RotorState, seconds
from perch_core.vehicle import GRAVITY
from perch_autopilot import msp
from perch_autopilot.arming import Arming, Stop
from perch_autopilot.clock import clock_jump
from perch_autopilot.configuration import load_configuration
from perch_autopilot.supervised_link import SupervisedLink
from perch_autopilot.rates import Sticks, commanded_vehicle, rate_curves
from perch_autopilot.watchdog import CENTRED, DESCENT, DISARM_AFTER, Mode, lifts
from perch_autopilot.link import REOPEN, LinkError

_HANDSHAKE = 2.0                     # for the autopilot's version [s]
_REFUSED = NANOSECONDS               # a command to arm without effect for so long is refused [ns]
_SLOW_REQUESTS = (msp.STATUS, msp.ATTITUDE, msp.ANALOG)


@dataclass(frozen=True, kw_only=True)
class BetaflightParameters:
    """Parameters of the node `betaflight`; all are read once, at the start."""

    vehicle: str = text("betaflight", doc="config/vehicles/<name>.yaml, or a file")
    link: str = text("/dev/ttyACM0", doc="/dev/ttyACM0, /dev/ttyACM0@921600, tcp:HOST:PORT")
    configuration: str = text("betaflight", doc="what the autopilot is set to: config/autopilot/<name>.txt, or a file")
    one_g: float = quantity(2048.0, above=0.0, high=1e4, doc="reading of its accelerometer at rest (RAW_IMU): 2048, before 4.6 512")
    disarm_after: float = quantity(DISARM_AFTER, unit="s", low=0.5, high=60.0, doc="time without a command until the motors stop")


class Betaflight(Component[BetaflightParameters]):
    """Commands a flight controller that runs Betaflight.

    Whether its motors turn depends on the commanded arming switch, on the firmware's own checks, and on the pilot, who can take
    control back at any time by the switch of the mode MSP OVERRIDE.
    """

    config_type = BetaflightParameters

    rates_thrust = Input(RatesThrust, "rates_thrust_command")
    command = Input(ControllerCommand, "controller/command")
    poll = Timer(0.01, stamping=True)
    imu = Output(ImuSample, "imu/data_raw")
    rotors = Output(RotorState, "rotor_state")

    def __init__(self, config: BetaflightParameters) -> None:
        """
        Raises:
            ConfigError: there is no such vehicle or configuration, or the vehicle takes other commands.
            LinkError: the link cannot be opened.
            MspError: no autopilot answers, or its firmware is not supported; or, unless it is armed already, it refuses to arm
                for a lasting reason, or the vehicle's thrust curve does not cover the battery's voltage.
        """
        super().__init__(config)
        vehicle, loaded = commanded_vehicle(config.vehicle), load_configuration(config.configuration)
        self._sticks = Sticks(vehicle, rate_curves(loaded.settings, loaded.source))
        self._link, self._parser = self._opened_link(), msp.Parser()
        self._status: msp.Status | None = None
        try:
            self.version = self._identify()
        except BaseException:
            self._link.close()
            raise
        self._polls, self._mode = 0, Mode.DISARMED.value
        self._attitude: tuple[float, float, float] | None = None
        self._battery: msp.Battery | None = None
        self._arming_since: int | None = None   # the host's time since which it is commanded to arm and is not armed [ns]
        self._lifted = self._status is not None and self._status.armed  # a command since arming has commanded lift; armed at the start, it may fly
        self._arming = Arming()
        self._arming.start(self._lifted)
        self._now: int | None = None            # of the last poll [ns]
        self._last_answer = self._last_diagnostics = self._last_open = self._reported_errors = 0

    def _opened_link(self) -> SupervisedLink:
        return SupervisedLink(self.config.link, *self._throttles(), self.config.disarm_after, self._sticks.curves[:2])

    def _throttles(self) -> tuple[int, int]:
        """Return the throttles of hover and descent [us]."""
        return self._sticks.throttle_for(1.0), self._sticks.throttle_for(DESCENT)

    def _identify(self) -> msp.Version:
        """Request the firmware's version, and check that it can fly."""
        required = (msp.FC_VARIANT, msp.FC_VERSION, msp.STATUS, msp.ANALOG)
        answers: dict[int, msp.Frame] = {}
        last, reports = time.monotonic() + _HANDSHAKE, [""]
        while time.monotonic() < last:
            self._link.request(b"".join(map(msp.request, required)))
            data, messages = self._link.receive(0.2)
            reports += messages
            for frame in self._parser.feed(data):
                answers[frame.command] = frame
            if answers.keys() >= set(required):
                version = msp.version(answers[msp.FC_VARIANT], answers[msp.FC_VERSION])
                self._status = status = msp.status(answers[msp.STATUS])
                if status.armed:  # in flight, it continues when the node is restarted
                    self._link.report_motors_turning()
                else:
                    self._update_battery(msp.battery(answers[msp.ANALOG]).voltage)
                    if status.lasting:
                        raise msp.MspError(f"{self.config.link}: the autopilot refuses to arm: {'; '.join(status.lasting)}")
                return version
        noise = (f"{self._parser.skipped} bytes received that are not MSP: is the baud rate right, and the autopilot's command line closed?"
                 if self._parser.skipped else "")
        raise msp.MspError("; ".join(filter(None, (f"{self.config.link}: no autopilot answers within {_HANDSHAKE:g} s", reports[-1], noise))))

    # -- to the autopilot --------------------------------------------------------------------------------------------

    def on_rates_thrust(self, command: RatesThrust) -> None:
        """Send a command to the autopilot; it is in effect until the next one, or until it is stale.

        Its age counts from its arrival: its stamp is that of a sample, by the clock of any sensor.
        """
        if not self._arming.command(seconds(self._now or 0), command.armed):
            self._link.kill()
            return
        sticks = self._sticks.channels(command.w_B, command.thrust) if command.armed else CENTRED
        self._lifted = command.armed and (self._lifted or lifts(sticks, self._throttles()[0]))
        self._link.command(command.armed, sticks)

    def on_command(self, command: ControllerCommand) -> None:
        """Stop the motors on KILL, unless it is stale, also where no controller is there to obey it."""
        if command.command != Command.KILL:
            return
        if command.is_stale(self._now or 0):
            self.warn(f"KILL of {seconds(command.stamp):.3f} s is too old: ignored; one with the stamp 0 never is")
            return
        self._arming.halt(Stop.KILL)
        self._link.kill()

    # -- from it -----------------------------------------------------------------------------------------------------

    def on_poll(self, now: int) -> None:
        """Process the newest answer of each kind; request the next IMU sample, and the other data in turn."""
        if self._now is None or (jump := clock_jump(self._now, now)):
            self._last_answer, self._last_diagnostics, self._arming_since = now, now - NANOSECONDS, None
            if self._now is not None:
                self.warn(jump)
        self._now = now
        try:
            data, messages = self._link.receive()
        except LinkError as error:
            data, messages = b"", []
            self._reopen(now, error)
        for line in messages:
            self._mode = line
            self.log(LogLine("info" if line in (Mode.DISARMED.value, Mode.FOLLOWING.value) else "warning", f"autopilot: {line}"))
        for frame in {frame.command: frame for frame in self._parser.feed(data)}.values():
            self._handle_frame(frame, now)
        self._polls += 1
        requests = msp.request(msp.RAW_IMU)
        if self._polls % 10 == 0:
            requests += msp.request(_SLOW_REQUESTS[self._polls // 10 % len(_SLOW_REQUESTS)])
        elif self._arming.in_doubt:
            requests += msp.request(msp.STATUS)
        self._link.request(requests)
        if now - self._last_diagnostics >= NANOSECONDS:
            self._last_diagnostics = now
            self._diagnose(now)

    def _reopen(self, now: int, ended: LinkError) -> None:
        """Restart the link's process: in flight, the vehicle follows the next command or descends; on the ground, it idles."""
        if 0 <= now - self._last_open < REOPEN * NANOSECONDS:
            return
        self._last_open = now
        self.log(LogLine("error", f"{ended}: it is restarted", 1.0))
        try:
            link = self._opened_link()
        except LinkError as error:
            self.log(LogLine("error", str(error), 1.0))
            return
        self._link.close()
        self._link = link
        if self._arming.stop not in (None, Stop.START):
            link.kill()
        elif self._status is not None and self._status.armed:
            if self._lifted or not self._arming.wanted:
                link.report_motors_turning()
            if self._arming.wanted and self._arming.stop is None:
                link.command(True, self._sticks.channels((0.0, 0.0, 0.0), GRAVITY) if self._lifted else CENTRED)

    def _handle_frame(self, frame: msp.Frame, now: int) -> None:
        try:
            if frame.command == msp.RAW_IMU:
                force, rate = msp.inertial(frame, self.config.one_g)
                self.imu(ImuSample(now, rate, force))
                self._last_answer = now
            elif frame.command == msp.STATUS:
                self._status = msp.status(frame)
                self._check_arming(self._status, now)
                if not self._status.armed and not self._arming.wanted:
                    self.rotors(RotorState(now, (0.0,) * 4, (0.0,) * 4))  # they stand
            elif frame.command == msp.ATTITUDE:
                self._attitude = msp.attitude(frame)
            elif frame.command == msp.ANALOG:
                self._battery = msp.battery(frame)
                self._update_battery(self._battery.voltage)
        except msp.MspError as error:
            self.warn(str(error), min_interval=1.0)

    def _update_battery(self, voltage: float) -> None:
        if self._sticks.battery.reference:
            self._sticks.set_voltage(voltage)
            self._link.set_throttles(*self._throttles())
            if not self._sticks.covers_voltage(voltage):
                low, high = self._sticks.battery.range
                raise msp.MspError(f"the battery has {voltage:g} V: the thrust curve of {self.config.vehicle} (actuation.battery) is of "
                                   f"{low:g} to {high:g} V")

    def _check_arming(self, status: msp.Status, now: int) -> None:
        """Report why the autopilot does not arm; it gives no reason if it does not use the arming switch of this node.

        Who disarms it (a pilot, a failsafe, a restart) is obeyed until the commands have the motors off, too.
        """
        before, by = self._arming.stop, Stop.WATCHDOG if self._mode == Mode.DISARMED.value else Stop.AUTOPILOT
        if self._arming.report(seconds(now), status.armed, 2, by) and by is Stop.AUTOPILOT:
            self.log(LogLine("error", f"{by.value}: it arms again after a disarm"))
        stop, wanted = self._arming.stop, self._arming.wanted
        if stop not in (None, Stop.START):
            self._link.kill()  # again: the first may have been lost
        elif before is not None and stop is None:
            self._link.command(False, CENTRED)  # the watchdog, too, may arm again
        if not wanted or status.armed:
            self._arming_since = None
            if stop is not None and wanted:
                self.log(LogLine("error", "the pilot must not hand over: its motors would stop until the controller has disarmed once", 2.0))
        elif self._arming_since is None:
            self._arming_since = now
        elif now - self._arming_since > _REFUSED:
            reasons = "; ".join(status.refusals) or (
                f"{stop.value}: disarm first" if stop is not None else
                "the pilot has not handed over: switch MSP OVERRIDE on" if self._mode == Mode.FOLLOWING.value else "its motors were stopped: disarm first")
            self.log(LogLine("error", f"the autopilot refuses to arm: {reasons}", 2.0))

    def _diagnose(self, now: int) -> None:
        if silent := now - self._last_answer > NANOSECONDS:
            self.log(LogLine("error", f"{self.config.link}: the autopilot is silent: check its power and its link", 5.0))
        if self._parser.checksum_errors > self._reported_errors:
            self._reported_errors = self._parser.checksum_errors
            self.warn(f"{self.config.link}: corrupt frames received from the autopilot: check the link and its baud rate", min_interval=5.0)
        values = {"firmware": str(self.version), "mode": self._mode, "torn_frames": self._parser.checksum_errors,
                  "skipped_bytes": self._parser.skipped}
        if self._status is not None:
            values |= {"armed": self._status.armed, "refusals": "; ".join(self._status.refusals)}
        if self._battery is not None:
            values |= {"voltage_v": self._battery.voltage, "current_a": self._battery.current, "rssi": self._battery.rssi}
        if self._attitude is not None:
            values |= dict(zip(("roll_rad", "pitch_rad", "heading_rad"), self._attitude))
        self.diagnostics(Diagnostics(now, values, 2 if silent else 0, "the autopilot is silent" if silent else "ok"))

    def close(self) -> None:
        """Stop commanding: a vehicle in flight descends after the watchdog's times."""
        self._link.close()
