"""An ArduCopter-like autopilot speaking real MAVLink 2 over any number of byte links.

Each link has its own sequence numbers, stream rates and parameter download, as a telemetry port has. Nothing streams
unasked but HEARTBEAT, STATUSTEXT and TIMESYNC. What is not for the vehicle is passed on to the other links. Lockstep
and real time differ in the clock alone. The truth is for the simulator; it never reaches a link unless SIM_STATE is
asked for by name.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, Clock, S, Ticker
from morpheyes_daemon.simulation.airframe.dynamics import Truth, Vehicle
from morpheyes_daemon.simulation.autopilot.commands import Commands
from morpheyes_daemon.simulation.autopilot.core import TICK_NS, Autopilot, Severity
from morpheyes_daemon.simulation.autopilot.ekf import EstimatorNoise
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import RECOMMENDED, ParameterTable
from morpheyes_daemon.simulation.autopilot.rc_input import Radio
from morpheyes_daemon.simulation.autopilot.telemetry_port import AutopilotPort, ByteLink

_BOOT_NS = 2 * S
"""How long the links are silent after a reboot."""

_MOST_TICKS_AT_ONCE = 100
"""A longer hold-up in real time is caught up in pieces, so that links are served in between."""


class AutopilotTwin:
    """The autopilot of `vehicle`; give it links with `attach` and let `run` beat.

    `parameters` are changes to ArduCopter's defaults; None takes the recommended set of the simulated flights.
    `ready_after_s`: from boot to a position estimate (42 s with GPS on the real one).
    """

    def __init__(
        self,
        vehicle: Vehicle,
        clock: Clock,
        parameters: Mapping[str, float] | None = None,
        seed: int = 0,
        *,
        radio: Radio | None = None,
        noise: EstimatorNoise | None = None,
        ready_after_s: float = 1.0,
        old_parameter_names: bool = False,
    ) -> None:
        self._clock = clock
        self._ports: dict[int, AutopilotPort] = {}
        changes = RECOMMENDED if parameters is None else parameters
        self.parameters = ParameterTable(changes, old_names=old_parameter_names)
        self.radio = radio or Radio()
        self.drift = 0.0
        vehicle.start_at(clock.now_ns())
        self.autopilot = Autopilot(
            vehicle, self.radio, self.parameters, noise or EstimatorNoise(), seed, ready_after_s, self._say
        )
        self._commands = Commands(self.autopilot, self.reboot)
        self._up_ns = clock.now_ns()

    def attach(self, link: ByteLink) -> Callable[[bytes], None]:
        """Serve `link` from now on; returns what its received bytes must be handed to."""
        port = AutopilotPort(link, self.autopilot, int(self._sysid))
        self._ports[id(link)] = port
        return lambda data: self.on_bytes(link, data)

    @property
    def _sysid(self) -> float:
        """The vehicle's own system id."""
        return self.parameters.get("MAV_SYSID", self.parameters.get("SYSID_THISMAV", 1.0))

    def detach(self, link: ByteLink) -> None:
        """Forget a link that went away, with its stream rates."""
        self._ports.pop(id(link), None)

    def on_bytes(self, link: ByteLink, data: bytes) -> None:
        """Take bytes that arrived on `link`."""
        port = self._ports.get(id(link))
        if port is None or self._booting:
            return
        for message in port.parse(data):
            self._route(message, port)
            self._receive(message, port)

    async def run(self) -> None:
        """Beat at 100 Hz on the clock until cancelled."""
        ticker = Ticker(self._clock, S / TICK_NS)
        while True:
            await ticker.wait()
            self.advance(self._clock.now_ns())

    def advance(self, t_ns: int) -> None:
        """Fly up to `t_ns` and send what is due."""
        behind = (t_ns - self.autopilot.t_ns) // TICK_NS
        for _ in range(min(behind, _MOST_TICKS_AT_ONCE)):
            self.autopilot.tick()
            if self._booting:
                continue
            for port in list(self._ports.values()):
                port.stream(self.autopilot.t_ns)

    async def catch_up(self) -> None:
        """Nothing to wait for: the truth is known at once."""

    def truth_at(self, t_ns: int) -> Truth:
        """Return where the vehicle really was; for simulator and judge only. Raises InputError when too old."""
        return self.autopilot.vehicle.truth_at(t_ns)

    @property
    def _booting(self) -> bool:
        return self.autopilot.t_ns < self._up_ns

    def _say(self, severity: Severity, text: str) -> None:
        if self._booting:
            return
        for port in self._ports.values():
            port.send(mavlink.MAVLink_statustext_message(int(severity), text.encode()[:50]))

    def _route(self, message: Any, source: AutopilotPort) -> None:
        """Pass on what is not addressed to the vehicle alone, as ArduPilot's routing does."""
        if getattr(message, "target_system", 0) == self._sysid:
            return
        for port in self._ports.values():
            if port is not source:
                port.forward(bytes(message.get_msgbuf()))

    def _receive(self, message: Any, port: AutopilotPort) -> None:
        target = getattr(message, "target_system", 0)
        component = getattr(message, "target_component", 0)
        if target not in (0, self._sysid) or component not in (0, mavlink.MAV_COMP_ID_AUTOPILOT1):
            return
        handler = _HANDLERS.get(message.get_type())
        if handler is not None:
            handler(self, message, port)

    def _on_heartbeat(self, message: Any, _: AutopilotPort) -> None:
        if message.get_srcSystem() in self.parameters.gcs_sysids():
            self.autopilot.see_gcs()

    def _on_override(self, message: Any, _: AutopilotPort) -> None:
        if message.get_srcSystem() not in self.parameters.gcs_sysids():
            return
        values = [int(getattr(message, f"chan{n}_raw")) for n in range(1, 17)]
        self.autopilot.rc.override(self.autopilot.t_ns, values)
        self.autopilot.see_gcs()

    def _on_command_long(self, message: Any, port: AutopilotPort) -> None:
        params = [float(getattr(message, f"param{n}")) for n in range(1, 8)]
        self._acknowledge(message, params, port)

    def _on_command_int(self, message: Any, port: AutopilotPort) -> None:
        params = [float(getattr(message, f"param{n}")) for n in range(1, 5)]
        self._acknowledge(message, [*params, float(message.x), float(message.y), float(message.z)], port)

    def _acknowledge(self, message: Any, params: list[float], port: AutopilotPort) -> None:
        result = self._commands.execute(int(message.command), params, port)
        source = message.get_srcSystem(), message.get_srcComponent()
        port.send(mavlink.MAVLink_command_ack_message(int(message.command), result, 0, 0, *source))

    def _on_set_mode(self, message: Any, _: AutopilotPort) -> None:
        self._commands.set_mode(message.custom_mode)

    def _on_set_origin(self, _: Any, port: AutopilotPort) -> None:
        if self.autopilot.estimator.set_origin():
            port.send_once(mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN)

    def _on_timesync(self, message: Any, port: AutopilotPort) -> None:
        if message.tc1 == 0:
            since_boot_ns = self._clock.now_ns() - self.autopilot.boot_ns
            port.send(mavlink.MAVLink_timesync_message(max(1, since_boot_ns), message.ts1))

    def _on_param_list(self, _: Any, port: AutopilotPort) -> None:
        port.list_parameters()

    def _on_param_read(self, message: Any, port: AutopilotPort) -> None:
        index = int(message.param_index)
        name = str(message.param_id) if index == -1 else self.parameters.name_at(index)
        if name is not None and name in self.parameters:
            port.send_parameter(name)

    def _on_param_set(self, message: Any, port: AutopilotPort) -> None:
        name = str(message.param_id)
        if self.parameters.set(name, float(message.param_value)):
            for each in self._ports.values():
                each.send_parameter(name)

    # Faults, for tests and the fault matrix

    def reboot(self) -> None:
        """Restart the autopilot: motors stop, links are silent for a while, rates and estimate are gone."""
        self.autopilot.boot(self.autopilot.t_ns)
        self._up_ns = self.autopilot.t_ns + _BOOT_NS + round(self.parameters["BRD_BOOT_DELAY"] * MS)
        for port in self._ports.values():
            port.forget()

    def set_mode(self, mode: Mode) -> bool:
        """Change the flight mode as the pilot or a ground station would."""
        return self.autopilot.set_mode(mode)

    def ignore_overrides(self, *, ignore: bool = True) -> None:
        """Make the autopilot deaf to RC_CHANNELS_OVERRIDE, silently."""
        self.autopilot.rc.ignore_overrides = ignore

    def lose_flow(self, *, lost: bool = True) -> None:
        """Take away (or give back) the optical flow, or GPS where that is the position source."""
        if lost:
            self.autopilot.estimator.lose_aiding()
        else:
            self.autopilot.estimator.regain_aiding()

    def ekf_unhealthy(self, *, unhealthy: bool = True) -> None:
        """Let the EKF's variances rise above any threshold, or fall back."""
        self.autopilot.estimator.variance = 2.0 if unhealthy else 0.05

    def battery_low(self, fraction: float = 0.1) -> None:
        """Leave only `fraction` of the charge."""
        self.autopilot.battery.drop_to(fraction)

    def lose_radio(self, *, lost: bool = True) -> None:
        """Switch the pilot's transmitter off, or on again."""
        self.radio.heard = not lost

    def disarm_in_flight(self) -> None:
        """Stop the motors wherever the vehicle is."""
        self.autopilot.disarm(force=True)


_HANDLERS: dict[str, Callable[[AutopilotTwin, Any, AutopilotPort], None]] = {
    "HEARTBEAT": AutopilotTwin._on_heartbeat,
    "RC_CHANNELS_OVERRIDE": AutopilotTwin._on_override,
    "COMMAND_LONG": AutopilotTwin._on_command_long,
    "COMMAND_INT": AutopilotTwin._on_command_int,
    "SET_MODE": AutopilotTwin._on_set_mode,
    "SET_GPS_GLOBAL_ORIGIN": AutopilotTwin._on_set_origin,
    "TIMESYNC": AutopilotTwin._on_timesync,
    "PARAM_REQUEST_LIST": AutopilotTwin._on_param_list,
    "PARAM_REQUEST_READ": AutopilotTwin._on_param_read,
    "PARAM_SET": AutopilotTwin._on_param_set,
}
