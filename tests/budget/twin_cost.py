"""What vehicle and autopilot twin cost: `python -m tests.budget.twin_cost` prints shares of one core in real time.

Telemetry as the daemon asks for it: attitude, velocity and RC at 50 Hz, range at 20 Hz, health at 5 Hz.
"""

import time

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import S
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.airframe.wind import WindConditions
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from tests.support.hand_clock import HandClock

RATES_HZ = {
    mavlink.MAVLINK_MSG_ID_ATTITUDE: 50,
    mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED: 50,
    mavlink.MAVLINK_MSG_ID_RC_CHANNELS: 50,
    mavlink.MAVLINK_MSG_ID_DISTANCE_SENSOR: 20,
    mavlink.MAVLINK_MSG_ID_EKF_STATUS_REPORT: 5,
    mavlink.MAVLINK_MSG_ID_SYS_STATUS: 5,
}


class Sink:
    """A link that swallows everything."""

    def write(self, data: bytes) -> None:
        """Drop the bytes."""


def share_of_a_core(twin: AutopilotTwin, clock: HandClock, seconds: float) -> float:
    """Fly for simulated `seconds` and return CPU time over simulated time."""
    start_s = time.process_time()
    for _ in range(round(seconds * 100)):
        clock.t_ns += S // 100
        twin.advance(clock.t_ns)
    return (time.process_time() - start_s) / seconds


def main() -> None:
    """Take off in a wind, hover, and print both shares."""
    clock = HandClock()
    twin = AutopilotTwin(Vehicle(wind=WindConditions(3.0)), clock, seed=1)
    link = Sink()
    receive = twin.attach(link)
    share_of_a_core(twin, clock, 3.0)
    twin.set_mode(Mode.LOITER)
    twin.autopilot.arm()
    twin.radio.sticks(throttle_us=1750)
    share_of_a_core(twin, clock, 6.0)
    twin.radio.sticks()
    print(f"physics and autopilot: {share_of_a_core(twin, clock, 30.0):.1%} of a core")
    sender = mavlink.MAVLink(None, 255, 190)
    for message_id, rate_hz in RATES_HZ.items():
        command = mavlink.MAV_CMD_SET_MESSAGE_INTERVAL
        params = (message_id, 1e6 / rate_hz, 0, 0, 0, 0, 0)
        receive(mavlink.MAVLink_command_long_message(1, 1, command, 0, *params).pack(sender))
    print(f"with telemetry: {share_of_a_core(twin, clock, 30.0):.1%} of a core")


if __name__ == "__main__":
    main()
