"""Valid frames with senseless content from the vehicle itself: the connection lives on and moves no stick."""

from __future__ import annotations

import asyncio
import math
import struct

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.messages.core import VehicleState
from tests.contract.autopilot.test_autopilot_connection import with_connection
from tests.support.connection_bench import ConnectionBench

HEARD = (0, 1, 22, 30, 32, 65, 77, 111, 132, 193, 245, 253)
FRAMES = 6000


def frame(number: int, payload: bytes, seq: int) -> bytes:
    """A MAVLink 2 frame of the vehicle with any payload."""
    body = struct.pack("<BBBBBBHB", len(payload), 0, 0, seq % 256, 1, 1, number & 0xFFFF, number >> 16) + payload
    crc = mavlink.x25crc(body)
    crc.accumulate(bytes([mavlink.mavlink_map[number].crc_extra]))
    return b"\xfd" + body + struct.pack("<H", crc.crc)


@pytest.mark.parametrize("seed", [1, 2])
def test_senseless_content_raises_nothing_and_moves_nothing(seed: int) -> None:
    states: list[VehicleState] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        chance = np.random.default_rng(seed)
        failures: list[object] = []
        asyncio.get_running_loop().set_exception_handler(lambda loop, context: failures.append(context))
        bench.connection.on_vehicle(states.append)
        every = sorted(mavlink.mavlink_map)
        for i in range(FRAMES):
            number = int(chance.choice(HEARD if i % 2 else every))
            size = int(chance.integers(1, mavlink.mavlink_map[number].unpacker.size + 1))
            assert bench.link is not None
            bench.link.write(frame(number, chance.bytes(size), i))
            if i % 50 == 0:
                await bench.sleep(0.01)
        await bench.sleep(0.1)
        assert failures == []
        assert bench.sent_of("RC_CHANNELS_OVERRIDE") == []
        before = len(states)
        await bench.until(lambda: len(states) > before + 20, 10.0)  # the twin is still heard

    with_connection(story)
    for state in states:
        numbers = (state.roll_rad, state.pitch_rad, state.yaw_rad, *state.p_ned_m, *state.v_ned_m_s)
        assert all(math.isfinite(number) for number in numbers)
        assert len(state.rc_us) in (0, 16)
        assert state.attitude_t_ns <= state.t_ns
