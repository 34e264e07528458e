"""A daemon whose links a test holds in its hands, and the noise that is poured into them.

The daemon is the real one, put together by app.py, without cameras: its connection, its monitor and its servo live on
virtual time; what it sends is kept, what it hears is whatever the test says.
"""

from __future__ import annotations

import asyncio
import random
import struct
from binascii import crc_hqx
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from typing import Any, Self

from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S, running_clock
from morpheyes_daemon.config.vehicle import AutopilotConfig, MissionFile, ServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.daemon.composition import Daemon, Parts
from morpheyes_daemon.devices.family import DeviceContext
from morpheyes_daemon.devices.link import Link, OnBytes, OnLost
from morpheyes_daemon.devices.servo import build_servo
from morpheyes_daemon.messages.core import Event, RawPair, Sticks
from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.safety.leases import Lease
from morpheyes_daemon.simulation.airframe.dynamics import Vehicle
from morpheyes_daemon.simulation.autopilot.twin import AutopilotTwin
from morpheyes_daemon.vision_worker.inline import InlineWorker
from morpheyes_daemon.wire import servo as servo_wire

VEHICLE, STRANGER = (1, 1), (77, 7)
NASTY_FLOATS = (float("nan"), float("inf"), -float("inf"), 0.0, -0.0, 1e-40, 3e38, -3e38, 1.0, -1.0, 65535.0)


class Blind:
    """A camera that never delivers."""

    async def open(self) -> None:
        return

    async def read(self) -> RawPair:
        await asyncio.Event().wait()
        raise AssertionError

    async def close(self) -> None:
        return


class HeldLink:
    """The daemon's end of a link; keeps what was sent."""

    def __init__(self, on_bytes: OnBytes, on_lost: OnLost) -> None:
        self.on_bytes, self.on_lost = on_bytes, on_lost
        self.sent: list[bytes] = []
        self.receive: OnBytes = lambda data: None

    def write(self, data: bytes) -> None:
        self.sent.append(data)
        self.receive(data)

    def close(self) -> None:
        return


class _BackChannel:
    """The twin's end: what it writes arrives whole, between two pieces of noise."""

    def __init__(self, link: HeldLink) -> None:
        self._link = link

    def write(self, data: bytes) -> None:
        self._link.on_bytes(data)


class NoisyDaemon:
    """`async with NoisyDaemon()`: the daemon runs; `hear` brings bytes to one of its links.

    An autopilot twin answers on the autopilot's link, so that all streams and parameters are there; the servo's
    link is answered by nobody. With a `NoServoConfig` it stands by, ready to fly.
    """

    def __init__(self, servo_config: ServoConfig, mission: MissionFile | None = None) -> None:
        clock = running_clock()
        config = VehicleConfig(
            camera=SimCameraConfig(), servo=servo_config, autopilot=AutopilotConfig(url="memory:autopilot")
        )
        self.clock = clock
        self.twin = AutopilotTwin(Vehicle(), clock)
        self.states: Counter[State] = Counter()
        self.links: dict[str, HeldLink] = {}
        topics, log = Topics.create(), EventLog()
        self.events: list[Event] = []
        log.subscribe(self.events.append)
        servo = build_servo(config.servo, DeviceContext(clock, log, topics, self._open))
        worker: InlineWorker[Any, Any] = InlineWorker(lambda job: job, 0, clock)
        parts = Parts(clock=clock, camera=Blind(), servo=servo, opener=self._open, worker=worker)
        self.daemon = Daemon(config, mission or MissionFile(strategy="forest"), parts, topics, log)
        self._stop = asyncio.Event()

    async def __aenter__(self) -> Self:
        self._lives = [asyncio.create_task(self.daemon.run(self._stop)), asyncio.create_task(self.twin.run())]
        await self.pass_time(5.0)
        for _ in range(20):
            await self.pass_time(0.1)
        assert self.daemon.gate.has_limits
        return self

    async def __aexit__(self, *error: object) -> None:
        for life in self._lives:
            life.cancel()
            with suppress(asyncio.CancelledError):
                await life

    async def _open(self, url: str, on_bytes: OnBytes, on_lost: OnLost) -> Link:
        name = url.partition(":")[2]
        self.links[name] = link = HeldLink(on_bytes, on_lost)
        if name == "autopilot":
            link.receive = self.twin.attach(_BackChannel(link))
        return link

    async def pass_time(self, seconds: float) -> None:
        """Let the daemon live, as ready to fly as it can be; fails when it died."""
        now_ns = self.clock.now_ns()
        for lease in (Lease.FRAME, Lease.DEPTH, Lease.MISSION):
            self.daemon.gate.renew(lease, now_ns + S)
        self.daemon.gate.offer(Sticks(now_ns, now_ns + S, 1900, 1100, 1900, 1100))
        self.states[self.daemon.monitor.state] += 1
        await self.clock.sleep_until_ns(now_ns + round(seconds * S))
        assert not any(life.done() for life in self._lives), "the daemon died"

    def hear(self, link: str, data: bytes) -> None:
        """Bring bytes; whatever they are, nothing may be raised past the link's callback."""
        self.links[link].on_bytes(data)

    @property
    def overrides(self) -> list[tuple[int, ...]]:
        """Channels 1 to 4 of every RC_CHANNELS_OVERRIDE that was sent."""
        parser = mavlink.MAVLink(None)
        messages = [m for data in self.links["autopilot"].sent for m in parser.parse_buffer(data) or []]
        sticks = [m for m in messages if m.get_type() == "RC_CHANNELS_OVERRIDE"]
        return [(m.chan1_raw, m.chan2_raw, m.chan3_raw, m.chan4_raw) for m in sticks]


# -- noise ------------------------------------------------------------------------------------------------------

Noise = Callable[[random.Random], bytes]


def pure(rng: random.Random) -> bytes:
    """Random bytes, rich in frame markers and zeros."""
    data = bytearray(rng.randbytes(rng.randrange(1, 600)))
    for _ in range(len(data) // 40):
        data[rng.randrange(len(data))] = rng.choice((0xFD, 0xFE, 0x00, 0xFF))
    return bytes(data)


def mavlink_frame(rng: random.Random, sender: tuple[int, int] = VEHICLE) -> bytes:
    """A whole frame of any message of the dialect with a valid checksum and random contents."""
    kind = mavlink.mavlink_map[rng.choice(_MAVLINK_IDS)]
    stream = mavlink.MAVLink(None, *sender)
    stream.seq = rng.randrange(256)
    message = kind(*(_field(kind, name, rng) for name in kind.fieldnames))
    return bytes(message.pack(stream, force_mavlink1=rng.random() < 0.1 and kind.id < 256))


def parameter_frame(rng: random.Random) -> bytes:
    """A parameter that the daemon reads, with any value."""
    value = rng.choice(NASTY_FLOATS) if rng.random() < 0.5 else rng.uniform(-3000.0, 3000.0)
    message = mavlink.MAVLink_param_value_message(
        rng.choice(_PARAMETERS).encode(), value, 9, rng.choice((1, 40, 65535)), rng.randrange(65536)
    )
    return bytes(message.pack(mavlink.MAVLink(None, *VEHICLE)))


def damaged(frame: Noise) -> Noise:
    """Frames cut short, doubled, with flipped bits, or in the wrong order."""

    def noise(rng: random.Random) -> bytes:
        frames = [bytearray(frame(rng)) for _ in range(4)]
        rng.shuffle(frames)
        for one in frames:
            kind = rng.randrange(4)
            if kind == 0:
                del one[rng.randrange(len(one)) :]
            elif kind == 1:
                one[rng.randrange(len(one))] ^= 1 << rng.randrange(8)
            elif kind == 2:
                one.extend(bytes(one))
        return b"".join(frames)

    return noise


def servo_frame(rng: random.Random) -> bytes:
    """A valid frame of the servo's protocol with random contents."""
    pick = rng.randrange
    message: servo_wire.Message = rng.choice(
        (
            servo_wire.Ack(pick(256), rng.choice(list(servo_wire.Verdict)), pick(65536) / 1e5),
            servo_wire.Welcome(pick(3), pick(65536), pick(65536) / 1e5, pick(65536) / 1e5),
            servo_wire.Status(pick(2**32), pick(65536) / 1e5, servo_wire.StatusFlag(pick(4)), pick(65536)),
            servo_wire.SetTarget(pick(256), pick(65536) / 1e5),
            servo_wire.Hello(pick(256)),
        )
    )
    return servo_wire.encode(message)


def servo_body(rng: random.Random) -> bytes:
    """A frame with a valid checksum around any body."""
    body = bytes([rng.choice((1, 2, 0x81, 0x82, 0x83, pick_byte(rng)))]) + rng.randbytes(rng.randrange(14))
    crc = crc_hqx(body, 0xFFFF).to_bytes(2, "big")
    return servo_wire.cobs_encode(body + crc) + b"\0"


def pick_byte(rng: random.Random) -> int:
    return rng.randrange(256)


def stream(noises: tuple[Noise, ...], rng: random.Random, total: int) -> Iterator[bytes]:
    """Yield `total` bytes of noise, cut where no frame ends."""
    while total > 0:
        data = b"".join(rng.choice(noises)(rng) for _ in range(8))
        total -= len(data)
        cut = rng.randrange(len(data) + 1)
        yield data[:cut]
        yield data[cut:]


_MAVLINK_IDS = sorted(mavlink.mavlink_map)
_OFTEN = ("HEARTBEAT", "RC_CHANNELS", "ATTITUDE", "LOCAL_POSITION_NED", "SYS_STATUS", "STATUSTEXT", "COMMAND_ACK")
_MAVLINK_IDS += [kind.id for kind in mavlink.mavlink_map.values() if kind.msgname in _OFTEN] * 60
_PARAMETERS = (
    [f"RC{n}_{what}" for n in range(1, 5) for what in ("MIN", "MAX", "TRIM", "DZ", "REVERSED")]
    + ["RCMAP_ROLL", "RCMAP_PITCH", "RCMAP_THROTTLE", "RCMAP_YAW", "LOIT_SPEED", "LOIT_BRK_ACCEL", "LOIT_BRK_JERK"]
    + ["LOIT_BRK_DELAY", "LOIT_ANG_MAX", "ANGLE_MAX", "THR_DZ", "PILOT_SPEED_UP", "PILOT_SPEED_DN", "PILOT_Y_RATE"]
    + ["EK3_MAX_FLOW", "EK3_SRC1_VELXY", "PSC_VELXY_P", "PSC_NE_VEL_P"]
)


def _field(kind: Any, name: str, rng: random.Random) -> Any:
    index = kind.fieldnames.index(name)
    size = kind.array_lengths[kind.ordered_fieldnames.index(name)]
    wire_type = kind.fieldtypes[index]
    if wire_type == "char":
        return rng.randbytes(size or 1)
    values = [_number(wire_type, rng) for _ in range(size or 1)]
    return values if size else values[0]


def _number(wire_type: str, rng: random.Random) -> float | int:
    if wire_type in ("float", "double"):
        return rng.choice(NASTY_FLOATS) if rng.random() < 0.3 else rng.uniform(-100.0, 100.0)
    bits = next((bits for bits in ("16", "32", "64") if bits in wire_type), "8")
    code = {"8": "b", "16": "h", "32": "i", "64": "q"}[bits]
    code = code.upper() if wire_type.startswith("u") else code
    return int(struct.unpack(f"<{code}", rng.randbytes(struct.calcsize(f"<{code}")))[0])
