"""Why the vehicle braked, was released, was refused or stopped: one code, the same everywhere.

The code appears in the log, STATUSTEXT, NAMED_VALUE_INT (its number), systemd STATUS and on the dashboard.
Numbers are never used twice, since they stand in old DataFlash logs; 60 and 62 are retired.
"""

from enum import StrEnum


class Reason(StrEnum):
    """A reason; `number` is what NAMED_VALUE_INT carries and `text` what a person reads."""

    number: int
    text: str

    def __new__(cls, code: str, number: int, text: str) -> "Reason":
        """Make a member of its code, NAMED_VALUE_INT number and text."""
        member = str.__new__(cls, code)
        member._value_ = code
        member.number = number
        member.text = text
        return member

    # ordinary life
    STARTED = "started", 1, "the daemon started"
    READY = "ready", 2, "everything needed is present and fresh"
    ENGAGED = "engaged", 3, "the pilot's switch handed the sticks over"
    GOAL_REACHED = "goal_reached", 4, "the mission reached its goal"
    MISSION_REFUSED = "mission_refused", 5, "the mission judged the task not safely possible"
    SHUTDOWN = "shutdown", 6, "the daemon was asked to stop"
    RECOVERED = "recovered", 7, "the missing input is back"
    STOP_REQUESTED = "stop_requested", 8, "somebody asked for a stop on the page"
    PRIORITY_KEPT = "priority_kept", 9, "a process could not lower its priority"

    # the pilot
    SWITCH_OFF = "switch_off", 20, "the pilot's switch is off"
    SWITCH_NOT_SEEN_OFF = "switch_not_seen_off", 21, "the switch must be seen off once before it can engage"
    MODE_NOT_LOITER = "mode_not_loiter", 22, "the autopilot is not in Loiter"
    DISARMED = "disarmed", 23, "the vehicle is not armed"
    ALREADY_FLYING = "already_flying", 24, "the daemon started in flight: it only observes"
    LANDED = "landed", 25, "the vehicle is on the ground"

    # inputs that went stale
    FRAME_STALE = "frame_stale", 40, "no fresh camera frame"
    DEPTH_STALE = "depth_stale", 41, "no fresh depth map"
    MISSION_STALE = "mission_stale", 42, "no fresh mission command"
    VEHICLE_STALE = "vehicle_stale", 43, "no fresh attitude or velocity from the autopilot"
    LINK_LOST = "link_lost", 44, "the autopilot link is silent"
    SUPERVISOR_STALE = "supervisor_stale", 45, "the supervisor did not renew its lease"
    SWITCH_STALE = "switch_stale", 46, "the pilot's switch has not been heard of lately"
    GCS_LOST = "gcs_lost", 47, "the ground station's heartbeat is gone"
    BASELINE_STALE = "baseline_stale", 48, "the servo does not answer"
    PARAMETERS_UNKNOWN = "parameters_unknown", 49, "the autopilot's parameters have not been read yet"

    # what the mission and governor brake for
    NO_FREE_PATH = "no_free_path", 61, "no free direction is in sight"
    IMAGE_BAD = "image_bad", 63, "the images are frozen, dark, swapped or do not match"
    DEPTH_SCALE = "depth_scale", 65, "depth does not fit the motion: the eyes are not where the servo should hold them"
    EYES_APART = "eyes_apart", 66, "the eyes' rows stay apart: not exposed together, bent, or another rig's calibration"
    EYES_LATE = "eyes_late", 67, "the time between the eyes is not the one declared"
    BASELINE_UNKNOWN = "baseline_unknown", 68, "the eyes are still on their way to a place that is known"
    CALIBRATION_DRIFT = "calibration_drift", 64, "the eyes no longer point where the calibration says"

    # faults
    TASK_DIED = "task_died", 80, "a task of the daemon died"
    LOOP_LATE = "loop_late", 81, "the event loop was held up"
    WORKER_LOST = "worker_lost", 82, "the vision worker hung or died"
    OVERRIDE_IGNORED = "override_ignored", 83, "the autopilot ignores the overrides"
    DOCTOR_SAYS_NO = "doctor_says_no", 84, "a preflight finding says do not fly"
    CAMERA_LOST = "camera_lost", 85, "the camera went away"
    SERVO_LOST = "servo_lost", 86, "the servo link went away"
    EKF_UNHEALTHY = "ekf_unhealthy", 87, "the autopilot's position estimate is not healthy"
    BATTERY_LOW = "battery_low", 88, "the battery is low"
    RC_LOST = "rc_lost", 89, "the autopilot lost the pilot's radio"
    FAILSAFE = "failsafe", 90, "the autopilot started a failsafe"
    COMMAND_INVALID = "command_invalid", 91, "a command was not finite or out of bounds"
    AUTOPILOT_REBOOTED = "autopilot_rebooted", 92, "the autopilot restarted"
    RECORDER_FAILED = "recorder_failed", 93, "the flight log cannot be written"
    CLOCK_STEPPED = "clock_stepped", 94, "the clock jumped"
    AIDING_LOST = "aiding_lost", 95, "the autopilot lost its optical flow or its GPS fix"
