"""The fault matrix: what can break, in which state, and how each must end. A table, and nothing else.

`fault_endings` has the rule for each ending, `fault_acts` says what each fault does, `fault_run` flies the table.
"""

from __future__ import annotations

from collections.abc import Mapping

from morpheyes_daemon.fault_injection import faults as actions
from morpheyes_daemon.fault_injection import injectors
from morpheyes_daemon.fault_injection.expectations import Fault, FaultOutcome
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.servo.teensy import ServoFault

FRAME_S, DEPTH_S, LINK_S, VEHICLE_S, SWITCH_S = 0.6, 0.7, 0.5, 0.3, 0.5
"""Declared times to notice: three camera periods, the same and the matcher's latency, and the time-outs."""

APART_S, SCALE_S, REBOOT_S = 3.0, 4.5, 0.8
"""Eight frames that turn or pitch, or the way on which the time between the eyes shows; the servos' way to where
depth is a third too large, five frames and latency; the Teensy's boot and its next STATUS."""

GPS_S, FLOW_S = 0.3, 0.7
"""The period in which the fix is told; the autopilot calls the flow lost after 0.5 s, and tells ten times a second."""

HEARTBEAT_S, RC_S, STATUS_S, PICTURE_S = 0.1, 0.05, 0.1, 0.3
"""Periods of the messages, and of a picture with its matching."""

E = FaultOutcome
_AIR = (State.ENGAGED, State.BRAKING, State.HOLD, State.STANDBY)


def _row(*endings: FaultOutcome | None, ground: FaultOutcome | None = None) -> Mapping[State, FaultOutcome]:
    """Endings in ENGAGED, BRAKING, HOLD and STANDBY, and on the ground; None: cannot happen there, or is no news."""
    pairs = zip((*_AIR, State.PREFLIGHT), (*endings, ground), strict=True)
    return {state: ending for state, ending in pairs if ending is not None}


_STOPPED = _row(E.HOLDS, E.HOLDS, E.HOLDS, E.UNREADY)
_STOPPED_THEN_WELL = _row(E.HOLDS, E.HOLDS, E.HOLDS, E.READY)
_BLIP = _row(E.RESUMES, None, E.HOLDS, E.READY)
_HARMLESS = _row(E.FLIES, E.RESUMES, E.HOLDS, E.READY)
_PATCHY = _row(E.FLIES_WITH_PAUSES, E.FLIES_WITH_PAUSES, E.HOLDS, E.READY)
_TAKEN = _row(E.RELEASES, E.RELEASES, E.RELEASES, None)
_LEFT = _row(E.LETS_GO, E.LETS_GO, E.LETS_GO, E.UNREADY)
_PERHAPS = _row(E.HOLDS_IF_IT_MATTERS, E.HOLDS_IF_IT_MATTERS, E.HOLDS, None)
_SEEN_IN_MOTION = _row(E.HOLDS, E.HOLDS, E.HOLDS, None)
_DEAD = _row(E.STOPS, E.STOPS, E.STOPS, E.UNREADY)

FAULTS: tuple[Fault, ...] = (
    Fault("nothing", "control: nothing breaks", 0.0, _row(E.FLIES, E.RESUMES, E.HOLDS, E.READY, ground=E.READY)),
    # camera
    Fault("camera-stall", "the camera stalls", FRAME_S, _STOPPED, actions.stall_camera),
    Fault(
        "camera-blip",
        "the camera stalls for 1 s",
        FRAME_S,
        _BLIP,
        actions.stall_camera,
        actions.restart_camera,
        1.0,
    ),
    Fault(
        "camera-unplugged",
        "the camera is unplugged",
        FRAME_S,
        _row(E.HOLDS, E.HOLDS, E.HOLDS, E.UNREADY, ground=E.UNREADY),
        actions.unplug_camera,
    ),
    Fault(
        "camera-replugged",
        "the camera is unplugged for 0.5 s",
        FRAME_S,
        _STOPPED_THEN_WELL,
        actions.unplug_camera,
        actions.plug_camera_in,
        0.5,
    ),
    Fault(
        "image-frozen",
        "the same picture for ever",
        DEPTH_S + PICTURE_S,
        _STOPPED,
        actions.retouch(injectors.frozen_picture),
    ),
    Fault(
        "eyes-swapped",
        "left and right exchanged",
        DEPTH_S + PICTURE_S,
        _STOPPED,
        actions.retouch(lambda: injectors.swapped_eyes),
    ),
    Fault(
        "eye-black",
        "the right eye sees nothing",
        DEPTH_S + PICTURE_S,
        _STOPPED,
        actions.retouch(lambda: injectors.black_eye),
    ),
    Fault("image-burnt", "exposure burnt out", DEPTH_S + PICTURE_S, _STOPPED, actions.burn_out),
    Fault("desync-5ms", "the right eye 5 ms late", 0.0, _PERHAPS, actions.desynchronize(5.0)),
    Fault(
        "desync-20ms",
        "the right eye 20 ms late",
        APART_S,
        _SEEN_IN_MOTION,
        actions.desynchronize(20.0),
        watch_s=11.0,
    ),
    Fault(
        "desync-50ms",
        "the right eye 50 ms late",
        APART_S,
        _SEEN_IN_MOTION,
        actions.desynchronize(50.0),
        watch_s=11.0,
    ),
    # depth
    Fault("depth-slow", "each depth map 1 s late", DEPTH_S, _STOPPED, actions.slow_worker),
    Fault("depth-hung", "the matcher hangs until it is killed", DEPTH_S, _STOPPED, actions.hang_worker),
    Fault(
        "depth-killed",
        "the matcher is killed and started again",
        PICTURE_S,
        _STOPPED_THEN_WELL,
        actions.kill_worker,
        actions.mend_worker,
        0.3,
    ),
    Fault(
        "depth-died-idle",
        "the matcher dies between two frames",
        0.0,
        _STOPPED_THEN_WELL,
        actions.kill_idle_worker,
        actions.mend_worker,
        0.5,
    ),
    Fault("depth-crashing", "the matcher raises at every frame", PICTURE_S, _STOPPED, actions.crash_pipeline),
    # calibration
    Fault("calibration-missing", "no calibration file", 0.0, _row(*[None] * 4, ground=E.REFUSES), rig_seed=None),
    Fault(
        "calibration-other",
        "calibration of another rig",
        APART_S,
        _row(*[None] * 4, ground=E.UNREADY),
        rig_seed=3,
        watch_s=12.0,
    ),
    # servo
    Fault("servo-stuck", "the servos stick, targets are acknowledged", 0.0, _PERHAPS, actions.servo(ServoFault.STUCK)),
    Fault(
        "servo-silent",
        "the Teensy is silent",
        1.5,
        _row(E.HOLDS, E.HOLDS, E.HOLDS, E.UNREADY, ground=E.UNREADY),
        actions.servo(ServoFault.SILENT),
    ),
    Fault("servo-garbage", "the Teensy sends garbage", 1.5, _STOPPED, actions.servo(ServoFault.GARBAGE)),
    Fault(
        "servo-runs-in",
        "the servos run in and stay there, targets are acknowledged",
        SCALE_S,
        _SEEN_IN_MOTION,
        actions.servo(ServoFault.RUNS_IN),
        watch_s=11.0,
    ),
    Fault(
        "servo-ran-in",
        "so they did before the pilot engaged: depth is wrong, which tells at speed only",
        SCALE_S + 2.0,
        _row(*[None] * 3, E.HOLDS_IF_IT_MATTERS),
        actions.servo(ServoFault.RUNS_IN),
        actions.engage,
        5.0,
        watch_s=14.0,
    ),
    Fault("servo-reboot", "the Teensy restarts", REBOOT_S, _STOPPED_THEN_WELL, actions.reboot_servo),
    Fault("servo-wrong", "the servos go 10 mm too far", 0.0, _HARMLESS, actions.servo(ServoFault.WRONG_POSITION)),
    # link
    Fault("link-lost", "both directions silent", VEHICLE_S, _DEAD, actions.lose_link),
    Fault("link-unplugged", "the port goes away", VEHICLE_S, _DEAD, actions.unplug_link),
    Fault(
        "uplink-lost",
        "the autopilot no longer hears the daemon",
        0.0,
        _row(E.STOPS, E.STOPS, E.STOPS, E.READY),
        actions.lose_uplink,
    ),
    Fault("downlink-lost", "the daemon no longer hears the autopilot", VEHICLE_S, _LEFT, actions.lose_downlink),
    Fault(
        "link-gap",
        "both directions silent for 1 s",
        VEHICLE_S,
        _STOPPED_THEN_WELL,
        actions.lose_link,
        actions.mend_link,
        1.0,
    ),
    Fault(
        "link-blip",
        "both directions silent for 0.2 s",
        0.0,
        _HARMLESS,
        actions.lose_link,
        actions.mend_link,
        0.2,
    ),
    Fault("link-garbage", "random bytes between the messages", 0.0, _HARMLESS, actions.noisy_link),
    Fault("link-truncated", "one message in five is cut short", 0.0, _PATCHY, actions.cutting_link),
    Fault("link-reordered", "messages overtake each other", 0.0, _HARMLESS, actions.swapping_link),
    Fault("link-doubled", "every message twice, both ways", 0.0, _HARMLESS, actions.doubling_link),
    Fault("forged-sender", "a stranger says: switch off, disarmed", 0.0, _HARMLESS, actions.forge),
    Fault(
        "autopilot-reboot",
        "the autopilot restarts, motors stop",
        VEHICLE_S,
        _row(E.LETS_GO, E.LETS_GO, E.LETS_GO, E.READY),
        actions.reboot_autopilot,
        falls=True,
    ),
    Fault(
        "overrides-ignored",
        "the autopilot ignores the sticks",
        1.5,
        _row(E.HOLDS, E.HOLDS, E.HOLDS, E.READY),
        actions.ignore_overrides,
    ),
    # pilot and vehicle
    Fault("pilot-mode", "the pilot switches to ALT_HOLD", HEARTBEAT_S, _TAKEN, actions.switch_mode(Mode.ALT_HOLD)),
    Fault("failsafe-mode", "a failsafe switches to LAND", HEARTBEAT_S, _TAKEN, actions.switch_mode(Mode.LAND)),
    Fault("switch-off", "the pilot flips the switch", RC_S + 0.02, _TAKEN, actions.switch_off),
    Fault("switch-stuck-on", "the switch is on at boot", 0.0, _row(*[None] * 4, ground=E.UNREADY), actions.switch_on),
    Fault("disarm", "the motors are stopped in flight", HEARTBEAT_S, _TAKEN, actions.disarm, falls=True),
    Fault(
        "disarm-rc-silent",
        "RC_CHANNELS stops, then the motors",
        actions.DISARM_AFTER_S + HEARTBEAT_S,
        _TAKEN,
        actions.disarm_without_radio,
        falls=True,
    ),
    Fault("rc-channels-lost", "RC_CHANNELS no longer comes", SWITCH_S, _STOPPED, actions.lose_rc_channels),
    Fault(
        "ekf-unhealthy",
        "the EKF's variances rise",
        1.2,
        _row(E.RELEASES, E.RELEASES, E.RELEASES, E.UNREADY),
        actions.upset_ekf,
    ),
    Fault("gps-lost", "GPS is lost", GPS_S, _LEFT, actions.lose_aiding, watch_s=12.0, settles=False),
    Fault("flow-lost", "optical flow is lost", FLOW_S, _LEFT, actions.lose_aiding, watch_s=12.0, without_gps=True),
    Fault("battery-low", "10 % of charge left", STATUS_S, _STOPPED, actions.drain_battery),
    Fault(
        "gcs-lost",
        "the ground station's heartbeat is gone (watched)",
        5.0,
        _STOPPED,
        actions.lose_ground_station,
        watch_s=11.0,
    ),
    Fault("rc-lost", "the pilot's radio is gone", RC_S + 0.02, _LEFT, actions.lose_radio),
    # the daemon
    Fault("loop-300ms", "the event loop is held up for 0.3 s", 0.3, _BLIP, actions.block_loop(0.3)),
    Fault("loop-900ms", "the event loop is held up for 0.9 s", 0.9, _STOPPED_THEN_WELL, actions.block_loop(0.9)),
    Fault("task-mission", "the mission task dies", PICTURE_S, _STOPPED_THEN_WELL, actions.kill_task("mission")),
    Fault("task-sticks", "the stick task dies", 0.02, _STOPPED_THEN_WELL, actions.kill_task("sticks")),
    Fault("task-capture", "the capture task dies", PICTURE_S, _STOPPED_THEN_WELL, actions.kill_task("capture")),
    Fault("task-baseline", "the baseline task dies", 0.1, _STOPPED_THEN_WELL, actions.kill_task("baseline")),
    Fault("clock-step", "the wall clock is set back", 0.0, _HARMLESS, actions.step_wall_clock),
    Fault("memory-pressure", "the kernel kills the matcher, all else waits 0.3 s", 0.6, _STOPPED, actions.starve),
    Fault("disk-full", "the log cannot grow", 0.0, _HARMLESS, actions.fill_disk),
    Fault("log-gone", "the log's device goes away", 0.0, _HARMLESS, actions.remove_log_device),
    Fault("sigterm", "systemd stops the daemon", 0.0, _LEFT, actions.terminate),
    Fault(
        "sigkill",
        "the daemon is killed and started again",
        0.0,
        _row(E.STOPS, E.STOPS, E.STOPS, E.READY),
        actions.die_and_restart,
        lasts_s=3.0,
    ),
    Fault("power-cut", "the companion computer loses power", 0.0, _DEAD, actions.die),
)
"""Every fault; the states of each are the keys of its endings."""
