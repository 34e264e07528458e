"""What each fault of the matrix does to a simulated flight, and how it is mended where it is.

One function per fault, each a few lines on the places where something can break (`FaultFlight`, `injectors`, the
twins' own fault hooks). What must follow stands in `faults.py`.
"""

from __future__ import annotations

import asyncio
import os
import resource
import sys
from collections.abc import Callable
from dataclasses import replace

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.fault_injection import injectors
from morpheyes_daemon.fault_injection.harness import FaultFlight
from morpheyes_daemon.messages.core import Event
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.servo.teensy import ServoFault
from morpheyes_daemon.vision_worker.inline import WorkerFailed, WorkerLost

Act = Callable[[FaultFlight], None]

WORKER_TIMEOUT_S = 1.0
"""After this long the process worker kills a hung child; here the twin of that (supervisor.worker_process)."""

FORGER = (42, 1)
"""Somebody else's system id, with an autopilot's component id."""

DISARM_AFTER_S = 0.4

# -- camera -------------------------------------------------------------------------------------------------------


def stall_camera(flight: FaultFlight) -> None:
    """The camera delivers no more frames."""
    flight.camera.stalled = True


def restart_camera(flight: FaultFlight) -> None:
    """A stalled camera delivers frames again."""
    flight.camera.stalled = False


def unplug_camera(flight: FaultFlight) -> None:
    """The camera is disconnected."""
    flight.camera.plugged = False


def plug_camera_in(flight: FaultFlight) -> None:
    """The camera is connected again."""
    flight.camera.plugged = True


def retouch(retouched: Callable[[], injectors.Retouch]) -> Act:
    """Have every pair changed from now on."""

    def act(flight: FaultFlight) -> None:
        flight.camera.retouch = retouched()

    return act


def desynchronize(offset_ms: float) -> Act:
    """The right eye exposes later by so much more."""

    def act(flight: FaultFlight) -> None:
        camera = flight.stage.camera
        camera.sensor = replace(camera.sensor, sync_offset_s=camera.sensor.sync_offset_s + offset_ms / 1e3)

    return act


def burn_out(flight: FaultFlight) -> None:
    """Fixed exposure far too long: both images saturate."""
    camera = flight.stage.camera
    camera.sensor = replace(camera.sensor, auto_exposure=False, exposure=40.0)


# -- depth --------------------------------------------------------------------------------------------------------


def slow_worker(flight: FaultFlight) -> None:
    """Each depth map takes one second longer."""
    flight.worker.extra_ns = 1_000_000_000


def hang_worker(flight: FaultFlight) -> None:
    """The vision worker no longer answers."""
    flight.worker.hung_s = WORKER_TIMEOUT_S


def kill_worker(flight: FaultFlight) -> None:
    """The vision worker dies by a signal."""
    flight.worker.gone = WorkerLost("The vision worker died (signal 9); a new one is being started.")


def crash_pipeline(flight: FaultFlight) -> None:
    """The pipeline in the vision worker raises an unexpected error."""
    flight.worker.gone = WorkerFailed("ValueError: something unforeseen")


def kill_idle_worker(flight: FaultFlight) -> None:
    """Between two frames, so that no job tells of it; until the next worker is ready frames wait."""
    daemon = flight.daemon
    text = "The vision worker died while idle (killed by SIGKILL); a new one is being started."
    daemon.events.publish(Event(flight.clock.now_ns(), "vision", Reason.WORKER_LOST, text))
    flight.worker.extra_ns = 500_000_000


def mend_worker(flight: FaultFlight) -> None:
    """The vision worker works as before."""
    flight.worker.gone, flight.worker.hung_s, flight.worker.extra_ns = None, None, 0


# -- servo --------------------------------------------------------------------------------------------------------


def servo(fault: ServoFault) -> Act:
    """One of the Teensy twin's own faults."""
    return lambda flight: flight.stage.teensy.inject(fault)


def engage(flight: FaultFlight) -> None:
    """The pilot hands over to a daemon that has not noticed."""
    flight.crew.engage()


def reboot_servo(flight: FaultFlight) -> None:
    """The Teensy restarts."""
    flight.stage.teensy.reboot()


# -- autopilot link -----------------------------------------------------------------------------------------------


def lose_link(flight: FaultFlight) -> None:
    """Nothing passes between daemon and autopilot in either direction."""
    flight.wire.incoming = flight.wire.outgoing = injectors.lose


def lose_downlink(flight: FaultFlight) -> None:
    """Nothing arrives from the autopilot."""
    flight.wire.incoming = injectors.lose


def lose_uplink(flight: FaultFlight) -> None:
    """Nothing reaches the autopilot."""
    flight.wire.outgoing = injectors.lose


def mend_link(flight: FaultFlight) -> None:
    """Both directions of the link pass bytes again."""
    flight.wire.incoming = flight.wire.outgoing = injectors.pass_on


def unplug_link(flight: FaultFlight) -> None:
    """The autopilot's port disappears."""
    flight.wire.unplug()


def noisy_link(flight: FaultFlight) -> None:
    """Random bytes are inserted into what arrives."""
    flight.wire.incoming = injectors.add_noise(flight.rng)


def cutting_link(flight: FaultFlight) -> None:
    """Messages arrive truncated."""
    flight.wire.incoming = injectors.cut_short(flight.rng)


def swapping_link(flight: FaultFlight) -> None:
    """Neighbouring messages arrive in swapped order."""
    flight.wire.incoming = injectors.swap_neighbours()


def doubling_link(flight: FaultFlight) -> None:
    """Each message arrives twice, in both directions."""
    flight.wire.incoming = flight.wire.outgoing = injectors.double


def forge(flight: FaultFlight) -> None:
    """Somebody else on the link says that the switch is off, the mode another and the motors stopped."""
    stranger = mavlink.MAVLink(None, *FORGER)

    def passage(data: bytes, deliver: Callable[[bytes], None]) -> None:
        off = [1500] * 4 + [1000] * 14
        for message in (
            mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3),
            mavlink.MAVLink_rc_channels_message(0, 16, *off, 200),
        ):
            deliver(bytes(message.pack(stranger)))
        deliver(data)

    flight.wire.incoming = passage


def reboot_autopilot(flight: FaultFlight) -> None:
    """The autopilot restarts in flight."""
    flight.stage.autopilot.reboot()


def ignore_overrides(flight: FaultFlight) -> None:
    """The autopilot ignores RC overrides."""
    flight.stage.autopilot.ignore_overrides()


# -- vehicle and pilot --------------------------------------------------------------------------------------------


def switch_mode(mode: Mode) -> Act:
    """The pilot, or a failsafe, changes the flight mode."""

    def act(flight: FaultFlight) -> None:
        flight.stage.autopilot.set_mode(mode)

    return act


def switch_off(flight: FaultFlight) -> None:
    """The pilot turns the engage switch off."""
    flight.stage.radio.switch(on=False)


def switch_on(flight: FaultFlight) -> None:
    """The pilot turns the engage switch on."""
    flight.stage.radio.switch(on=True)


def disarm(flight: FaultFlight) -> None:
    """The motors are disarmed in flight."""
    flight.stage.autopilot.disarm_in_flight()


def lose_message(number: int) -> Act:
    """One message of the autopilot no longer arrives."""

    def passage(data: bytes, deliver: Callable[[bytes], None]) -> None:
        if int.from_bytes(data[7:10], "little") != number:
            deliver(data)

    def act(flight: FaultFlight) -> None:
        flight.wire.incoming = passage

    return act


lose_rc_channels = lose_message(mavlink.MAVLINK_MSG_ID_RC_CHANNELS)


def disarm_without_radio(flight: FaultFlight) -> None:
    """RC_CHANNELS stops, and a little later the motors do."""
    lose_rc_channels(flight)
    asyncio.get_running_loop().call_later(DISARM_AFTER_S, flight.stage.autopilot.disarm_in_flight)


def upset_ekf(flight: FaultFlight) -> None:
    """The autopilot's EKF reports that it is unhealthy."""
    flight.stage.autopilot.ekf_unhealthy()


def lose_aiding(flight: FaultFlight) -> None:
    """The optical flow sensor falls silent."""
    flight.stage.autopilot.lose_flow()


def drain_battery(flight: FaultFlight) -> None:
    """The battery falls to 10 %."""
    flight.stage.autopilot.battery_low(0.1)


def lose_ground_station(flight: FaultFlight) -> None:
    """The ground station sends no more heartbeats."""
    flight.crew_task.cancel()


def lose_radio(flight: FaultFlight) -> None:
    """The pilot's radio is no longer received."""
    flight.stage.autopilot.lose_radio()


# -- the daemon itself --------------------------------------------------------------------------------------------


def block_loop(seconds: float) -> Act:
    """A call does not return for a while."""
    return lambda flight: flight.block_loop(seconds)


def kill_task(name: str) -> Act:
    """A task meets something unforeseen at its next turn."""

    def act(flight: FaultFlight) -> None:
        pulse = flight.daemon.supervisor.pulses[name]

        def fail() -> None:
            pulse.on_first = None
            raise RuntimeError("something unforeseen")

        pulse.on_first = fail

    return act


def starve(flight: FaultFlight) -> None:
    """The kernel takes the largest process, the worker, and the daemon waits for its pages."""
    kill_worker(flight)
    flight.block_loop(0.3)


def fill_disk(flight: FaultFlight) -> None:
    """The log cannot grow by a byte."""
    size = max(os.fstat(descriptor).st_size for descriptor in _open_log(flight))
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))


def remove_log_device(flight: FaultFlight) -> None:
    """The log's file goes away under the recorder."""
    for descriptor in _open_log(flight):
        os.close(descriptor)
    flight.recorder.path.unlink()


def _open_log(flight: FaultFlight) -> list[int]:
    """Return the descriptors of the log; another branch of the flight may have unlinked it."""
    path = str(flight.recorder.path.resolve())
    names = {int(name): os.path.realpath(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd")}
    return [descriptor for descriptor, name in names.items() if name.removesuffix(" (deleted)") == path]


def step_wall_clock(flight: FaultFlight) -> None:
    """The wall clock is set to 1970; only this process sees it."""
    sys.modules["time"].time = lambda: 0.0  # type: ignore[attr-defined]


def terminate(flight: FaultFlight) -> None:
    """The daemon receives SIGTERM."""
    flight.stop.set()


def die(flight: FaultFlight) -> None:
    """The daemon is killed (SIGKILL)."""
    flight.die()


def die_and_restart(flight: FaultFlight) -> None:
    """SIGKILL, and systemd starts it again a second later."""
    flight.die()
    asyncio.get_running_loop().call_later(1.0, flight.restart)
