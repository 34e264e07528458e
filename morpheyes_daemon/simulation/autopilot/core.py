"""The autopilot twin without its MAVLink face: arming, modes, failsafes, and the 100 Hz beat of it all.

Rules follow ArduCopter as measured (docs: field facts). Failsafes change the mode and never change it back.
What it has to say to people is handed to `say`; whoever listens turns it into STATUSTEXT.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from enum import IntEnum

from morpheyes_daemon.clock import MS, S
from morpheyes_daemon.simulation.airframe.dynamics import STEP_NS, Vehicle
from morpheyes_daemon.simulation.autopilot.aux_switches import AuxFunction, AuxSwitches, Position
from morpheyes_daemon.simulation.autopilot.battery import Battery
from morpheyes_daemon.simulation.autopilot.ekf import Estimate, Estimator, EstimatorNoise
from morpheyes_daemon.simulation.autopilot.flight_modes import FlightSettings, Mode
from morpheyes_daemon.simulation.autopilot.mode_controllers import FlightControl
from morpheyes_daemon.simulation.autopilot.parameters import ParameterTable
from morpheyes_daemon.simulation.autopilot.rc_input import PilotInput, Radio, RcInput

TICK_NS = 10 * MS
_STEPS = TICK_NS // STEP_NS
_STICK_DEAD_TICKS = 3
"""From an override to the first reaction; with the lean response this gives the measured 55-70 ms and 0.2 s."""

_EKF_COUNTS = 10
_EKF_PERIOD_NS = 100 * MS
_THROTTLE_LOW = 0.0
_LAND_WAIT_S = 4.0
"""A failsafe's LAND hovers this long before it descends."""


class Severity(IntEnum):
    """MAV_SEVERITY as far as it is used."""

    CRITICAL = 2
    WARNING = 4
    INFO = 6


Say = Callable[[Severity, str], None]


class Autopilot:
    """An ArduCopter around a vehicle; `tick` moves both by 10 ms."""

    def __init__(
        self,
        vehicle: Vehicle,
        radio: Radio,
        table: ParameterTable,
        noise: EstimatorNoise,
        seed: int,
        ready_after_s: float,
        say: Say,
    ) -> None:
        self.vehicle, self.radio, self.table = vehicle, radio, table
        self.estimator = Estimator(vehicle, table, noise, seed, ready_after_s)
        self.battery = Battery(seed)
        self.rc = RcInput(table, radio)
        self.control = FlightControl(vehicle, FlightSettings.of(table))
        self._say = say
        self._version = table.version
        self._delayed: deque[PilotInput] = deque(maxlen=_STICK_DEAD_TICKS + 1)
        self.boot_ns = vehicle.t_ns
        self.gcs_seen_ns: int | None = None
        self._gcs_lost = False
        self._ekf_bad = 0
        self._ekf_failed = self._ekf_passed = False
        self._idle_since_ns = vehicle.t_ns
        self._was_landed = True
        self.avoidance = True
        self._estimate: Estimate | None = None
        self._estimate_ns = 0
        self.boot(vehicle.t_ns)

    @property
    def t_ns(self) -> int:
        """Time of the newest physics step."""
        return self.vehicle.t_ns

    @property
    def boot_ms(self) -> int:
        """Milliseconds since boot, as MAVLink stamps them."""
        return (self.t_ns - self.boot_ns) // MS

    @property
    def mode(self) -> Mode:
        """Present flight mode."""
        return self.control.mode

    @property
    def armed(self) -> bool:
        """Motors may turn."""
        return self.control.armed

    @property
    def in_failsafe(self) -> bool:
        """A failsafe of radio, EKF, battery or ground station is on."""
        return self.rc.failsafe or self._ekf_failed or self.battery.low or self._gcs_lost

    @property
    def ready_to_arm(self) -> bool:
        """Nothing but the throttle stick stands against arming."""
        return self._unready() is None

    @property
    def estimate(self) -> Estimate:
        """What the autopilot believes, once per tick."""
        if self._estimate is None or self._estimate_ns != self.t_ns:
            self._estimate, self._estimate_ns = self.estimator.estimate(), self.t_ns
        return self._estimate

    def boot(self, t_ns: int) -> None:
        """Start up, also in the air, where the motors stop."""
        self.boot_ns = t_ns
        self.control.disarm()
        self.rc = RcInput(self.table, self.radio)
        self._switches = AuxSwitches(self.table)
        self.estimator.boot(t_ns)
        self.gcs_seen_ns = None
        self._gcs_lost, self._ekf_passed, self._ekf_failed, self._ekf_bad = False, False, False, 0
        self._delayed.clear()
        self.control.set_mode(_known_mode(self.table["INITIAL_MODE"]) or Mode.STABILIZE)

    def tick(self) -> None:
        """Advance by `TICK_NS`."""
        self._refresh_settings()
        self._read_radio()
        self._watch()
        pilot = self._delayed[0]
        for _ in range(_STEPS):
            self.control.step(pilot)
            self.vehicle.step()
        self.estimator.advance(self.t_ns, TICK_NS / S)
        self.battery.advance(TICK_NS / S, flying=not self.control.landed and self.armed)
        self.control.has_position = self.estimator.has_position
        self.control.dead_reckons = self.estimator.dead_reckons
        self.control.drift_m = (self.estimator.drift_m[0], self.estimator.drift_m[1])

    def _refresh_settings(self) -> None:
        if self.table.version != self._version:
            self._version = self.table.version
            self.control.settings = FlightSettings.of(self.table)

    def _read_radio(self) -> None:
        failsafe = self.rc.update(self.t_ns, armed=self.armed)
        if failsafe is True:
            self._radio_failsafe()
        elif failsafe is False:
            self._say(Severity.WARNING, "Radio Failsafe Cleared")
        position = self.rc.new_mode_position(self.t_ns)
        if position is not None:
            mode = _known_mode(self.table[f"FLTMODE{position}"])
            if mode is not None:
                self.set_mode(mode)
        for function, switched in self._switches.changes(self.t_ns, self.rc.channels_us):
            self.switch(function, switched)
        self._delayed.append(self.rc.pilot())

    def _watch(self) -> None:
        self._watch_gcs()
        if (self.t_ns // TICK_NS) % (_EKF_PERIOD_NS // TICK_NS) == 0:
            self._watch_estimator()
        self._watch_battery()
        self._watch_landing()
        self._watch_idling()

    def set_mode(self, mode: Mode, wait_s: float = 0.0) -> bool:
        """Change the flight mode; refused where a position is needed and there is none.

        `wait_s` holds back the descent of LAND.
        """
        if mode.needs_position and not self.estimator.has_position:
            self._say(Severity.WARNING, f"Mode change to {mode.name} failed: requires position")
            return False
        if mode is not self.mode:
            self.control.set_mode(mode, wait_s)
        return True

    def arm(self) -> str | None:
        """Arm from a ground station's command; returns why not, or None when armed."""
        if self.armed:
            return None
        refusal = self._arming_refusal()
        if refusal is not None:
            self._say(Severity.CRITICAL, f"Arm: {refusal}")
            return refusal
        self.control.arm()
        self._idle_since_ns = self.t_ns
        self._say(Severity.INFO, "Arming motors")
        return None

    def _arming_refusal(self) -> str | None:
        if self.mode is not Mode.GUIDED and self.rc.pilot().throttle > _THROTTLE_LOW:
            return self._unready() or "Throttle too high"
        return self._unready()

    def _unready(self) -> str | None:
        if self.mode.landing or self.mode is Mode.BRAKE:
            return f"{self.mode.name} mode not armable"
        if self.rc.failsafe:
            return "Radio failsafe on"
        if self._ekf_failed or (self.mode.needs_position and not self.estimator.has_position):
            return "Need Position Estimate"
        if not self.estimator.has_origin:
            return "AHRS: waiting for home"
        if self.table["FS_THR_ENABLE"] != 0:
            if not self.rc.ever_seen:
                return "RC not found"
            if self.rc.pulse_us("THROTTLE") < self.table["FS_THR_VALUE"] + _FAILSAFE_MARGIN_US:
                return "Throttle below failsafe"
        return None

    def disarm(self, *, force: bool = False) -> bool:
        """Disarm on command; in the air only by force."""
        if not (force or self.control.landed):
            return False
        self._stop_motors()
        return True

    def _stop_motors(self) -> None:
        if self.armed:
            self.control.disarm()
            self._say(Severity.INFO, "Disarming motors")

    def take_off(self, height_m: float) -> bool:
        """Take off in GUIDED."""
        if self.mode is not Mode.GUIDED or not self.armed or height_m <= 0.0:
            return False
        self.control.take_off(height_m)
        return True

    def switch(self, function: AuxFunction, position: Position) -> None:
        """Carry out an auxiliary function; the middle position changes nothing."""
        if position is Position.MIDDLE:
            return
        if function is AuxFunction.AVOID_PROXIMITY:
            self.avoidance = position is Position.HIGH
        elif function is AuxFunction.RC_OVERRIDE_ENABLE:
            self.rc.accept_overrides(enabled=position is Position.HIGH)

    def see_gcs(self) -> None:
        """Note a sign of life of the ground station: its heartbeat, or any accepted override."""
        self.gcs_seen_ns = self.t_ns

    def _radio_failsafe(self) -> None:
        self._say(Severity.WARNING, "Radio Failsafe")
        actions = {1: Mode.RTL, 2: Mode.RTL, 4: Mode.RTL, 5: Mode.LAND, 3: Mode.LAND, 6: Mode.RTL, 7: Mode.BRAKE}
        self._act(actions.get(int(self.table["FS_THR_ENABLE"]), Mode.LAND))

    def _act(self, mode: Mode) -> None:
        """Carry out a failsafe: on the ground disarm, in the air change the mode, LAND where that is refused."""
        if not self.armed:
            return
        if self.control.landed:
            self._stop_motors()
        elif not self.set_mode(mode, _LAND_WAIT_S):
            self.set_mode(Mode.LAND, _LAND_WAIT_S)

    def _watch_gcs(self) -> None:
        enabled = int(self.table["FS_GCS_ENABLE"])
        if enabled == 0 or self.gcs_seen_ns is None:
            return
        lost = self.t_ns - self.gcs_seen_ns > self.table["FS_GCS_TIMEOUT"] * S
        if lost and not self._gcs_lost:
            self._say(Severity.WARNING, "GCS Failsafe")
            self.rc.clear_overrides()
            pilot_flies = self.mode in (Mode.STABILIZE, Mode.ALT_HOLD, Mode.LOITER)
            if not (int(self.table["FS_OPTIONS"]) & _GCS_CONTINUE_IF_PILOT and pilot_flies):
                self._act({5: Mode.LAND, 7: Mode.BRAKE}.get(enabled, Mode.RTL))
        elif self._gcs_lost and not lost:
            self._say(Severity.WARNING, "GCS Failsafe Cleared")
        self._gcs_lost = lost

    def _watch_estimator(self) -> None:
        self._ekf_passed |= self.estimator.has_origin and self.estimator.healthy
        if not self._ekf_passed:
            return
        self._ekf_bad += -1 if self.estimator.healthy else 1
        self._ekf_bad = max(0, min(_EKF_COUNTS, self._ekf_bad))
        if self._ekf_bad == _EKF_COUNTS and not self._ekf_failed:
            self._ekf_failed = True
            self._say(Severity.CRITICAL, "EKF variance")
            if self.armed and self.mode.needs_position:
                self._act(Mode.LAND)
                self._say(Severity.CRITICAL, "EKF Failsafe: changed to LAND Mode")
        elif self._ekf_bad == 0 and self._ekf_failed:
            self._ekf_failed = False
            self._say(Severity.CRITICAL, "EKF Failsafe Cleared")

    def _watch_battery(self) -> None:
        if not self.battery.new_failsafe(self.table["BATT_LOW_VOLT"], self.table["BATT_LOW_TIMER"]):
            return
        self._say(Severity.WARNING, f"Battery 1 is low {self.battery.voltage_v:.2f}V used 0 mAh")
        action = {1: Mode.LAND, 2: Mode.RTL}.get(int(self.table["BATT_FS_LOW_ACT"]))
        if action is not None:
            self._act(action)

    def _watch_landing(self) -> None:
        if self.armed and self.control.landed and not self._was_landed and self.mode.landing:
            self._stop_motors()
        self._was_landed = self.control.landed

    def _watch_idling(self) -> None:
        """Disarm after DISARM_DELAY on the ground with the throttle low."""
        delay_s = self.table["DISARM_DELAY"]
        idle = self.armed and self.control.landed and self.rc.pilot().throttle <= _THROTTLE_LOW
        if not idle or delay_s == 0:
            self._idle_since_ns = self.t_ns
        elif self.t_ns - self._idle_since_ns >= delay_s * S:
            self._stop_motors()


_FAILSAFE_MARGIN_US = 10
_GCS_CONTINUE_IF_PILOT = 16


def _known_mode(number: float) -> Mode | None:
    try:
        return Mode(int(number))
    except ValueError:
        return None
