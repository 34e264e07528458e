"""The pilot's radio and what ArduCopter makes of it together with RC_CHANNELS_OVERRIDE.

`Radio` is the transmitter in the pilot's hands, scripted by whoever runs the simulation. `RcInput` follows
ArduCopter's rules: which override values mean what on which channels, when they expire, what is flown on after that,
and when the radio failsafe starts. It knows neither MAVLink nor flight modes.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from morpheyes_daemon.simulation.autopilot.parameters import CHANNELS, ParameterTable

FRAME_NS = 20_000_000
"""A receiver delivers 50 frames a second."""

KEEP = 65535
RELEASE_HIGH = 65534
_LOW_CHANNELS = 8
_GOOD_FRAMES = 3
_IGNORE_RECEIVER, _IGNORE_OVERRIDES = 1 << 0, 1 << 1
_SWITCH_SETTLE_NS = 200_000_000
_SWITCH_STEPS_US = (1230, 1360, 1490, 1620, 1749)


class Radio:
    """The pilot's transmitter and its receiver; channels are numbered from 1.

    `present` False: no receiver is wired. `heard` False: the transmitter is off or out of range.
    """

    MODE_CHANNEL = 5
    SWITCH_CHANNEL = 7
    MODE_US = {1: 1165, 2: 1295, 3: 1425, 4: 1555, 5: 1685, 6: 1815}
    """Middle of each position of a six-position mode switch."""

    def __init__(self, *, present: bool = True) -> None:
        self.present = present
        self.heard = True
        self.channels_us = [1500, 1500, 1000, 1500, 1165, 1500, 1000] + [1500] * (CHANNELS - 7)

    def set(self, channel: int, pulse_us: int) -> None:
        """Move one stick or switch."""
        self.channels_us[channel - 1] = pulse_us

    def sticks(self, roll_us: int = 1500, pitch_us: int = 1500, throttle_us: int = 1500, yaw_us: int = 1500) -> None:
        """Move the four sticks (standard channel order); what is not given is centred."""
        self.channels_us[:4] = (roll_us, pitch_us, throttle_us, yaw_us)

    def switch(self, *, on: bool) -> None:
        """Flip the pilot's engage switch."""
        self.set(self.SWITCH_CHANNEL, 1900 if on else 1000)

    def mode_switch(self, position: int) -> None:
        """Put the mode switch to position 1 to 6 (FLTMODE1 to 6)."""
        self.set(self.MODE_CHANNEL, self.MODE_US[position])


@dataclass(frozen=True, slots=True)
class PilotInput:
    """Sticks after calibration: angles -1 to 1, throttle 0 to 1000 with its middle; `valid` False in failsafe."""

    roll: float
    pitch: float
    yaw: float
    throttle: float
    throttle_middle: float
    valid: bool


class RcInput:
    """Receiver and overrides merged into the channels that the autopilot flies on."""

    def __init__(self, table: ParameterTable, radio: Radio) -> None:
        self._table = table
        self._radio = radio
        self.ignore_overrides = False
        self._accepting = True
        self.channels_us = [0] * CHANNELS
        self.failsafe = False
        self._override_us = [0] * CHANNELS
        self._override_ns = [0] * CHANNELS
        self._new_override = False
        self._next_frame_ns = 0
        self._updated_ns: int | None = None
        self._had_receiver = False
        self._bad_frames = 0
        self._pilot: PilotInput | None = None
        self._pilot_made_of: tuple[bool, int, tuple[int, ...]] | None = None
        self._switch = -1
        self._switch_candidate = -1
        self._switch_since_ns = 0

    def override(self, t_ns: int, values_us: Sequence[int]) -> None:
        """Take an accepted RC_CHANNELS_OVERRIDE; `values_us` holds channel 1 onwards."""
        if not self._accepting:
            return
        for index, value in enumerate(values_us[:CHANNELS]):
            if value == KEEP or (index >= _LOW_CHANNELS and value == 0):
                continue
            released = index >= _LOW_CHANNELS and value == RELEASE_HIGH
            self._override_us[index] = 0 if released else value
            self._override_ns[index] = t_ns
            self._new_override = True

    def accept_overrides(self, *, enabled: bool) -> None:
        """Take overrides from now on, or none (aux function 46, RC_OVERRIDE_ENABLE)."""
        self._accepting = enabled
        if not enabled:
            self.clear_overrides()

    def clear_overrides(self) -> None:
        """Forget every override (start of a ground-station failsafe)."""
        self._override_us = [0] * CHANNELS

    @property
    def ever_seen(self) -> bool:
        """Some input has arrived since boot."""
        return self._updated_ns is not None

    @property
    def receiver_frames(self) -> bool:
        """The receiver hears the transmitter."""
        return self._radio.present and self._radio.heard

    def update(self, t_ns: int, *, armed: bool) -> bool | None:
        """Read the inputs; returns True when the radio failsafe starts, False when it ends, else None."""
        new = self._new_override
        self._new_override = False
        if self.receiver_frames and t_ns >= self._next_frame_ns:
            self._next_frame_ns = t_ns + FRAME_NS
            self._had_receiver = new = True
        if new and self._read(t_ns):
            self._updated_ns = t_ns
            return self._judge_throttle(armed=armed)
        return self._judge_silence(t_ns, armed=armed)

    def _read(self, t_ns: int) -> bool:
        options = int(self._table["RC_OPTIONS"])
        overrides = not (options & _IGNORE_OVERRIDES or self.ignore_overrides)
        receiver = self._had_receiver and not options & _IGNORE_RECEIVER
        any_read = False
        for index in range(CHANNELS):
            if overrides and self._overridden(index, t_ns):
                self.channels_us[index] = self._override_us[index]
            elif receiver:
                self.channels_us[index] = self._radio.channels_us[index]
            else:
                continue
            any_read = True
        return any_read

    def _overridden(self, index: int, t_ns: int) -> bool:
        if self._override_us[index] == 0:
            return False
        hold_s = self._table["RC_OVERRIDE_TIME"]
        return hold_s < 0.0 or t_ns - self._override_ns[index] < hold_s * 1e9

    def _judge_throttle(self, *, armed: bool) -> bool | None:
        if self._table["FS_THR_ENABLE"] == 0:
            return self._set_failsafe(on=False)
        if self.pulse_us("THROTTLE") < self._table["FS_THR_VALUE"]:
            if self.failsafe or not (self.ever_seen or armed):
                return None
            self._bad_frames = min(self._bad_frames + 1, _GOOD_FRAMES)
            return self._set_failsafe(on=True) if self._bad_frames == _GOOD_FRAMES else None
        self._bad_frames = max(self._bad_frames - 1, 0)
        return self._set_failsafe(on=False) if self._bad_frames == 0 else None

    def _judge_silence(self, t_ns: int, *, armed: bool) -> bool | None:
        if self._table["FS_THR_ENABLE"] == 0 or (self._updated_ns is None and not armed):
            return None
        if t_ns - (self._updated_ns or 0) < self._table["RC_FS_TIMEOUT"] * 1e9:
            return None
        return self._set_failsafe(on=True)

    def _set_failsafe(self, *, on: bool) -> bool | None:
        if on == self.failsafe:
            return None
        self.failsafe = on
        return on

    def pulse_us(self, stick: str) -> int:
        """Return the pulse of ROLL, PITCH, THROTTLE or YAW by RCMAP_*; 0 when never seen."""
        return self.channels_us[int(self._table[f"RCMAP_{stick}"]) - 1]

    def pilot(self) -> PilotInput:
        """Return the sticks as the flight modes see them; the same object while nothing changes."""
        valid = self.ever_seen and not self.failsafe and self._bad_frames == 0
        made_of = valid, self._table.version, tuple(self.channels_us)
        if self._pilot is None or made_of != self._pilot_made_of:
            self._pilot, self._pilot_made_of = self._calibrated(valid=valid), made_of
        return self._pilot

    def _calibrated(self, *, valid: bool) -> PilotInput:
        if not valid:
            return PilotInput(0.0, 0.0, 0.0, 0.0, self._throttle(self._middle_us()), False)
        return PilotInput(
            roll=self._angle("ROLL"),
            pitch=self._angle("PITCH"),
            yaw=self._angle("YAW"),
            throttle=self._throttle(self.pulse_us("THROTTLE")),
            throttle_middle=self._throttle(self._middle_us()),
            valid=True,
        )

    def _angle(self, stick: str) -> float:
        n = int(self._table[f"RCMAP_{stick}"])
        table, pulse = self._table, self.channels_us[n - 1]
        high = table[f"RC{n}_TRIM"] + table[f"RC{n}_DZ"]
        low = table[f"RC{n}_TRIM"] - table[f"RC{n}_DZ"]
        most, least = table[f"RC{n}_MAX"], table[f"RC{n}_MIN"]
        sign = -1.0 if table[f"RC{n}_REVERSED"] else 1.0
        if pulse > high and most > high:
            return sign * min(1.0, (pulse - high) / (most - high))
        if pulse < low and low > least:
            return sign * max(-1.0, (pulse - low) / (low - least))
        return 0.0

    def _middle_us(self) -> float:
        n = int(self._table["RCMAP_THROTTLE"])
        return math.floor((self._table[f"RC{n}_MIN"] + self._table[f"RC{n}_MAX"]) / 2.0)

    def _throttle(self, pulse_us: float) -> float:
        n = int(self._table["RCMAP_THROTTLE"])
        table = self._table
        least, most = table[f"RC{n}_MIN"], table[f"RC{n}_MAX"]
        pulse = max(least, min(most, pulse_us))
        if table[f"RC{n}_REVERSED"]:
            pulse = most - (pulse - least)
        low = least + table[f"RC{n}_DZ"]
        return max(0.0, 1000.0 * (pulse - low) / (most - low))

    def new_mode_position(self, t_ns: int) -> int | None:
        """Return the mode switch's position 1 to 6 when it has just settled on a new one, else None."""
        channel = int(self._table["FLTMODE_CH"])
        if not 1 <= channel <= CHANNELS or not self.ever_seen or self.failsafe:
            return None
        pulse = self.channels_us[channel - 1]
        if not 900 < pulse < 2200:
            return None
        position = sum(pulse > step for step in _SWITCH_STEPS_US) + 1
        if position != self._switch_candidate:
            self._switch_candidate, self._switch_since_ns = position, t_ns
        if position == self._switch or t_ns - self._switch_since_ns < _SWITCH_SETTLE_NS:
            return None
        self._switch = position
        return position
