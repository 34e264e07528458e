"""The connection against the autopilot twin: what it asks for, what it hears, how it comes back, and who it says it is."""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable
from pathlib import Path

import numpy as np
import pytest
from pymavlink.dialects.v20 import ardupilotmega as mavlink

from morpheyes_daemon.clock import MS, S, run_virtual, wall_time_s
from morpheyes_daemon.errors import ConfigError, DeviceError, DeviceTimeoutError
from morpheyes_daemon.messages.core import VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.simulation.autopilot.flight_modes import Mode
from morpheyes_daemon.simulation.autopilot.parameters import RECOMMENDED
from morpheyes_daemon.wire.mavlink import RELEASE, ChannelOverride, Decoder, Encoder, Identity, Signing
from tests.support.connection_bench import DELAY_S, ConnectionBench

VEHICLE, DAEMON, GCS = Identity(1, 1), Identity(255, 191), Identity(255, 190)


def with_connection(story: Callable[[ConnectionBench], Awaitable[None]], **settings: object) -> None:
    async def tell() -> None:
        async with ConnectionBench(**settings) as bench:  # type: ignore[arg-type]
            await story(bench)

    run_virtual(tell())


def inject(bench: ConnectionBench, message: object, sender: Identity) -> None:
    """Put a message on the wire as if `sender` had sent it to us."""
    assert bench.link is not None
    bench.link.write(Encoder().pack(message, sender))


def test_rates_and_parameters_are_there_within_two_seconds() -> None:
    async def story(bench: ConnectionBench) -> None:
        assert await bench.until(lambda: bench.connection.parameters.complete) < 2.0
        await bench.ready()
        assert bench.connection.parameters.values["LOIT_SPEED"] == 500.0
        assert len(bench.connection.parameters.values) == len(bench.twin.parameters)
        counts: dict[int, int] = {}
        bench.connection.on_frame(lambda frame: counts.__setitem__(frame[7], counts.get(frame[7], 0) + 1))
        await bench.sleep(4.0)
        for number, rate in [(30, 50), (32, 50), (65, 20), (0, 10), (193, 5), (1, 10), (24, 5), (245, 2)]:
            assert counts[number] == pytest.approx(4 * rate, abs=2)
        assert bench.connection.refused_streams == []

    with_connection(story)


def test_state_is_what_the_twin_flies_stamped_when_measured() -> None:
    stamps: list[tuple[int, int]] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        await bench.sleep(3.0)  # a few TIMESYNC exchanges
        bench.connection.on_vehicle(lambda state: stamps.append((bench.clock.now_ns(), state.attitude_t_ns)))
        await bench.sleep(1.0)
        state = bench.vehicle
        truth = bench.twin.truth_at(state.attitude_t_ns)
        assert state.yaw_rad == pytest.approx(truth.yaw_rad, abs=0.05)
        assert not state.armed
        assert state.landed
        assert state.custom_mode == Mode.STABILIZE
        assert state.battery_v > 10.0
        assert state.rc_us[:4] == (1500, 1500, 1000, 1500)
        assert state.height_m == pytest.approx(0.2, abs=0.2)

    with_connection(story)
    fresh = min(now - stamp for now, stamp in stamps)
    # the link's delay is found by TIMESYNC; the autopilot's stamps are whole milliseconds
    assert fresh == pytest.approx(DELAY_S * S, abs=1.1 * MS)


def test_edges_are_heard_before_the_reception_returns() -> None:
    heard: list[tuple[int, int]] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        bench.connection.on_vehicle(lambda state: heard.append((bench.clock.now_ns(), state.custom_mode)))
        heard.clear()
        sent_ns = bench.clock.now_ns()
        inject(bench, mavlink.MAVLink_heartbeat_message(2, 3, 1, Mode.LAND, 4, 3), VEHICLE)
        await bench.sleep(DELAY_S)
        arrived = next(t_ns for t_ns, mode in heard if mode == Mode.LAND)
        assert arrived - sent_ns == pytest.approx(DELAY_S * S, abs=1000)

    with_connection(story)


def test_others_on_the_link_are_not_the_vehicle() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        before = bench.vehicle
        forged = mavlink.MAVLink_heartbeat_message(2, 3, 128, Mode.LAND, 4, 3)
        for sender in (Identity(1, 2), Identity(2, 1), Identity(255, 1), DAEMON):
            inject(bench, forged, sender)
            inject(bench, mavlink.MAVLink_attitude_message(1, 1.0, 1.0, 1.0, 0, 0, 0), sender)
        await bench.sleep(0.05)
        assert not bench.vehicle.armed
        assert bench.vehicle.custom_mode == before.custom_mode
        assert abs(bench.vehicle.roll_rad) < 0.1
        assert bench.vehicle.gcs_t_ns == 0
        inject(bench, mavlink.MAVLink_heartbeat_message(6, 8, 0, 0, 4, 3), GCS)
        await bench.sleep(0.05)
        assert bench.vehicle.gcs_t_ns > 0

    with_connection(story)


def test_numbers_that_are_not_finite_leave_the_state_to_go_stale() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        inject(bench, mavlink.MAVLink_attitude_message(10**6, math.nan, 0, 0, 0, 0, 0), VEHICLE)
        inject(bench, mavlink.MAVLink_local_position_ned_message(10**6, 0, math.inf, 0, 0, 0, 0), VEHICLE)
        states: list[VehicleState] = []
        bench.connection.on_vehicle(states.append)
        await bench.sleep(0.1)
        assert states
        assert all(math.isfinite(state.roll_rad) and math.isfinite(state.p_ned_m[1]) for state in states)

    with_connection(story)


def test_every_message_has_its_identity_and_no_heartbeat_poses_as_a_ground_station() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        output = bench.connection.claim_stick_output()
        output(ChannelOverride((1500, 1450, 1500, 1500)))
        output(RELEASE)
        bench.connection.send_statustext(6, "hello " * 20)
        bench.connection.send_named_float("me_base", 0.2)
        bench.connection.send_named_int("me_state", 3)
        bench.connection.send_obstacle_distance(np.full(72, 3.0, np.float32), 0.8, 20.0)
        await bench.sleep(2.0)
        for message in bench.sent:
            sender = Identity(message.get_srcSystem(), message.get_srcComponent())
            expected = {"RC_CHANNELS_OVERRIDE": DAEMON, "OBSTACLE_DISTANCE": Identity(1, 196)}
            assert sender == expected.get(message.get_type(), Identity(1, 197)), message
        heartbeats = bench.sent_of("HEARTBEAT")
        assert len(heartbeats) >= 2
        assert {message.type for message in heartbeats} == {mavlink.MAV_TYPE_ONBOARD_CONTROLLER}
        assert {m.get_type() for m in bench.sent} >= {"STATUSTEXT", "NAMED_VALUE_FLOAT", "NAMED_VALUE_INT"}

    with_connection(story)


def test_overrides_value_channels_1_to_4_and_leave_the_others_alone() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        output = bench.connection.claim_stick_output()
        output(ChannelOverride((1501, 1450, 1502, 1503)))
        output(RELEASE)
        await bench.sleep(0.1)
        sticks, release = (
            [getattr(message, f"chan{n}_raw") for n in range(1, 19)] for message in bench.sent_of("RC_CHANNELS_OVERRIDE")
        )
        assert sticks == [1501, 1450, 1502, 1503, *[65535] * 4, *[0] * 10]
        assert release == [0, 0, 0, 0, *[65535] * 4, *[0] * 10]

    with_connection(story)


def test_sticks_have_one_way_out() -> None:
    async def story(bench: ConnectionBench) -> None:
        bench.connection.claim_stick_output()
        with pytest.raises(RuntimeError, match="claimed"):
            bench.connection.claim_stick_output()
        for message in (
            mavlink.MAVLink_rc_channels_override_message(1, 1, *[1500] * 8),
            mavlink.MAVLink_manual_control_message(1, 0, 0, 0, 0, 0),
        ):
            with pytest.raises(ValueError, match="stick output"):
                bench.connection.transmitter.send(message, DAEMON)
            with pytest.raises(ValueError, match="stick output"):
                bench.connection.transmitter.send_status(message)

    with_connection(story)


async def _stream(bench: ConnectionBench, output: Callable[[ChannelOverride], None], seconds: float) -> None:
    end_ns = bench.clock.now_ns() + round(seconds * S)
    while bench.clock.now_ns() < end_ns:
        output(ChannelOverride((1500, 1400 + bench.clock.now_ns() // (20 * MS) % 50, 1500, 1500)))
        await bench.sleep(0.02)


@pytest.mark.parametrize("cause", ["deaf", "wrong id"])
def test_ignored_overrides_are_noticed_within_a_second_and_a_half(cause: str) -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        output = bench.connection.claim_stick_output()
        if cause == "deaf":
            await _stream(bench, output, 2.0)
            assert Reason.OVERRIDE_IGNORED not in bench.reasons
            bench.twin.ignore_overrides()
        start_ns = bench.clock.now_ns()
        await _stream(bench, output, 4.5 if cause == "deaf" else 2.0)
        ignored = [event for event in bench.events if event.reason is Reason.OVERRIDE_IGNORED]
        assert len(ignored) == 1
        # RC_OVERRIDE_TIME is 1 s: so long the twin shows the last stick, which may equal a newer one of ours
        assert (ignored[0].t_ns - start_ns) / S < (3.2 if cause == "deaf" else 1.5)
        if cause == "deaf":
            bench.twin.ignore_overrides(ignore=False)
            await _stream(bench, output, 1.0)
            assert bench.reasons[-1] is Reason.RECOVERED

    config = {} if cause == "deaf" else {"override_sysid": 7}
    with_connection(story, **config)


def test_releasing_and_silence_are_no_ignored_overrides() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        output = bench.connection.claim_stick_output()
        await _stream(bench, output, 1.0)
        output(RELEASE)
        await bench.sleep(3.0)
        await _stream(bench, output, 0.3)
        await bench.sleep(3.0)
        assert Reason.OVERRIDE_IGNORED not in bench.reasons

    with_connection(story)


def test_unplugged_and_plugged_in_again() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        bench.pull()
        took = await bench.until(lambda: Reason.LINK_LOST in bench.reasons)
        assert took < 0.1
        await bench.sleep(20.0)
        assert bench.reasons.count(Reason.LINK_LOST) == 1
        assert bench.opened < 12  # backs off instead of hammering
        bench.plugged = True
        await bench.until(lambda: bench.reasons[-1] is Reason.RECOVERED, 6.0)
        before_ns = bench.clock.now_ns()
        await bench.until(lambda: bench.vehicle.attitude_t_ns > before_ns, 2.0)
        await bench.until(lambda: len(bench.sent_of("PARAM_REQUEST_LIST")) == 2, 3.0)

    with_connection(story)


def test_silence_is_reported_in_time_and_the_port_opened_again() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        bench.mute()
        took = await bench.until(lambda: Reason.LINK_LOST in bench.reasons)
        assert 0.5 <= took < 0.6
        assert not bench.connection.up
        await bench.until(lambda: bench.connection.up, 8.0)
        assert bench.opened == 2
        assert bench.reasons.count(Reason.LINK_LOST) == 1
        assert bench.reasons[-1] is Reason.RECOVERED

    with_connection(story)


def test_reboot_is_noticed_and_everything_asked_again() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        await bench.sleep(10.0)
        bench.twin.parameters.set("LOIT_SPEED", 321)
        bench.twin.reboot()
        start_ns = bench.clock.now_ns()
        await bench.until(lambda: bench.connection.parameters.values["LOIT_SPEED"] == 321, 10.0)
        assert bench.reasons.count(Reason.AUTOPILOT_REBOOTED) == 1
        await bench.sleep(1.0)
        assert bench.vehicle.attitude_t_ns > start_ns

    with_connection(story)


def test_link_that_mixes_garbage_into_everything_still_works() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.until(lambda: bench.link is not None)
        noise = np.random.default_rng(5)
        for _ in range(400):
            assert bench.link is not None
            bench.link.write(noise.bytes(int(noise.integers(1, 60))))
            await bench.sleep(0.01)
        assert bench.connection.parameters.complete
        seen_ns = bench.vehicle.attitude_t_ns
        assert bench.clock.now_ns() - seen_ns < 100 * MS
        assert bench.connection.bad_bytes > 5000

    with_connection(story)


def test_lost_parameter_values_are_asked_for_again() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.until(lambda: bench.link is not None)
        link, lossy = bench.link, np.random.default_rng(3)
        assert link is not None
        send = link.write

        def drop_some(data: bytes) -> None:
            if lossy.random() > 0.3:
                send(data)

        link.write = drop_some  # type: ignore[method-assign]
        await bench.until(lambda: bench.connection.parameters.complete, 30.0)
        assert dict(bench.connection.parameters.values) == {
            n: pytest.approx(v) for n, v in bench.twin.parameters.items()
        }

    with_connection(story)


def test_setting_a_parameter() -> None:
    told: list[float] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        bench.connection.parameters.on_change(lambda values: told.append(values["LOIT_SPEED"]))
        await bench.connection.set_parameter("LOIT_SPEED", 450.0)
        assert bench.twin.parameters["LOIT_SPEED"] == 450.0
        assert told == [450.0]
        await bench.connection.set_parameter("LOIT_BRK_DELAY", 0.1)
        with pytest.raises(DeviceError, match="FS_THR_ENABLE"):
            await bench.connection.set_parameter("FS_THR_ENABLE", 1.4)
        with pytest.raises(DeviceTimeoutError, match="NO_SUCH"):
            await bench.connection.set_parameter("NO_SUCH", 1.0)

    with_connection(story)


def test_commands_are_acknowledged_or_refused_with_a_sentence() -> None:
    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        await bench.connection.set_aux_function(40, 0)
        with pytest.raises(DeviceError, match="refuses MAV_CMD_DO_PARACHUTE: unsupported"):
            await bench.connection.send_command(mavlink.MAV_CMD_DO_PARACHUTE, 2)
        bench.mute()
        with pytest.raises(DeviceTimeoutError, match="MAV_CMD_DO_AUX_FUNCTION"):
            await bench.connection.set_aux_function(40, 2)

    with_connection(story, parameters=RECOMMENDED)


def test_texts_of_the_vehicle_are_passed_on() -> None:
    texts: list[tuple[int, str]] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.ready()
        bench.connection.on_text(lambda severity, text: texts.append((severity, text)))
        inject(bench, mavlink.MAVLink_statustext_message(2, b"PreArm: 3D Accel calibration needed"), VEHICLE)
        inject(bench, mavlink.MAVLink_statustext_message(2, b"from somebody else"), Identity(9, 1))
        await bench.sleep(0.1)

    with_connection(story)
    assert texts == [(2, "PreArm: 3D Accel calibration needed")]


def test_hub_is_deterministic() -> None:
    async def flight() -> list[bytes]:
        frames: list[bytes] = []
        async with ConnectionBench() as bench:
            bench.connection.on_frame(frames.append)
            output = bench.connection.claim_stick_output()
            await bench.ready()
            await _stream(bench, output, 2.0)
            return frames + [bytes(message.get_msgbuf()) for message in bench.sent]

    assert run_virtual(flight()) == run_virtual(flight())


def test_signed_link_hears_nobody_unsigned_and_signs_everything(tmp_path: Path) -> None:
    key = bytes(range(100, 132))
    (tmp_path / "key").write_text(key.hex())
    seen_by_peer: list[bytes] = []

    async def story(bench: ConnectionBench) -> None:
        await bench.sleep(2.5)  # the twin signs nothing
        assert not bench.connection.up
        assert bench.connection.rejected_frames > 0
        assert bench.link is not None
        wall_s = wall_time_s()
        for stranger in (Signing(bytes(32), wall_s), None):
            frame = Encoder(stranger).pack(mavlink.MAVLink_heartbeat_message(2, 3, 128, Mode.LAND, 4, 3), VEHICLE)
            bench.link.write(frame)
        await bench.sleep(0.05)
        assert not bench.vehicle.armed
        signed = Encoder(Signing(key, wall_s))
        bench.link.write(signed.pack(mavlink.MAVLink_heartbeat_message(2, 3, 128, Mode.LOITER, 4, 3), VEHICLE))
        await bench.sleep(0.05)
        assert bench.connection.up
        assert bench.vehicle.armed
        bench.connection.claim_stick_output()(RELEASE)
        await bench.sleep(1.5)
        seen_by_peer.extend(bytes(message.get_msgbuf()) for message in bench.sent)

    with_connection(story, signing_key_file=tmp_path / "key")
    peer = Decoder(Signing(key, wall_time_s()))
    kinds = {message.get_type() for frame in seen_by_peer for message in peer.feed(frame)}
    assert {"HEARTBEAT", "RC_CHANNELS_OVERRIDE", "COMMAND_LONG"} <= kinds
    assert peer.rejected == 0


def test_signing_key_that_cannot_be_read_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "key").write_text("not hexadecimal")
    for path, words in [(tmp_path / "key", "hexadecimal"), (tmp_path / "none", "no such file")]:
        with pytest.raises(ConfigError, match=words):
            with_connection(lambda bench: bench.sleep(0.1), signing_key_file=path)
