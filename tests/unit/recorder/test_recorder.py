"""The recorder writes what was said, holds nobody up, and outlives its disk."""

import asyncio
import json
import os
from pathlib import Path

import pytest
from mcap.reader import make_reader

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import MonotonicClock, S
from morpheyes_daemon.config.vehicle import MissionFile, NoServoConfig, SimCameraConfig, VehicleConfig
from morpheyes_daemon.messages.core import Event, Sticks
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.recorder.flight_log import CHUNK_BYTES, FlightLog, flight_header, flight_path
from morpheyes_daemon.recorder.reader import Flight, read_flight
from morpheyes_daemon.recorder.recorder import QUEUE_LIMIT, Recorder
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight
from tests.unit.recorder.test_spool import disk_full_at

CONFIG = VehicleConfig(camera=SimCameraConfig(), servo=NoServoConfig(backend="none"))


class Bench:
    """Topics, events, a hand-set clock and a recorder on them."""

    def __init__(self, path: Path, *, image_rate_hz: float | None = 1.0) -> None:
        self.topics, self.events, self.clock = Topics.create(), EventLog(), HandClock()
        self.seen: list[Event] = []
        self.events.subscribe(self.seen.append)
        mission = MissionFile(strategy="forest", parameters={"baseline_gain": 0.05})
        header = flight_header("forest", mission, CONFIG, "5f1e", 0.0)
        self.recorder = Recorder(
            self.topics, self.events, self.clock, path, header, image_rate_hz=image_rate_hz, threaded=False
        )
        self.flight = SyntheticFlight(self.topics, self.events, self.clock)

    def stick(self) -> None:
        t = self.clock.t_ns
        self.topics.sticks.publish(Sticks(t, t + S, 1500, 1400, 1500, 1500))

    def reasons(self) -> list[Reason]:
        return [event.reason for event in self.seen]


def flown(tmp_path: Path, seconds: float = 6.0) -> tuple[Bench, Flight]:
    bench = Bench(tmp_path / "flight.mcap")
    bench.flight.fly(seconds)
    bench.recorder.close()
    return bench, read_flight(tmp_path / "flight.mcap")


def test_every_topic_is_kept_as_often_as_its_table_says(tmp_path: Path) -> None:
    bench, flight = flown(tmp_path)
    for name, every in (("sticks", 1), ("vehicle", 5), ("governed", 5), ("baseline", 2), ("perception", 1)):
        published = getattr(bench.topics, name).count
        assert len(flight.values(name)) == -(-published // every), name
    assert len(flight.values("image/left")) == 6
    assert len(flight.values("image/depth")) == 6
    assert flight.damage.finished


def test_values_come_back_as_the_messages_they_were(tmp_path: Path) -> None:
    bench, flight = flown(tmp_path)
    assert flight.values("sticks")[-1] == bench.topics.sticks.get()
    assert flight.values("command")[-1] == bench.topics.command.get()
    assert flight.values("gate")[-1] == bench.topics.gate.get()
    assert flight.events == bench.seen


def test_header_says_what_flew(tmp_path: Path) -> None:
    header = flown(tmp_path, 0.1)[1].header
    assert header["mission"] == "forest"
    assert header["calibration_hash"] == "5f1e"
    assert VehicleConfig.model_validate_json(header["config"]) == CONFIG
    assert json.loads(header["mission_file"])["parameters"] == {"baseline_gain": 0.05}
    assert header["wall_time"] == "1970-01-01T00:00:00+00:00"


def test_chunks_stay_small_and_any_mcap_tool_opens_the_file(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", image_rate_hz=30.0)
    bench.flight.fly(20.0)
    bench.recorder.close()
    with (tmp_path / "a.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None
        assert max(index.uncompressed_size for index in summary.chunk_indexes) <= CHUNK_BYTES
        assert sum(1 for _ in reader.iter_messages()) == bench.recorder.health().written
        names = {schema.name for schema in summary.schemas.values()}
    assert {"foxglove.CompressedImage", "foxglove.PoseInFrame", "foxglove.Log"} <= names


def test_a_full_disk_is_told_once_and_nothing_is_lost_when_room_returns(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap")
    bench.stick()
    with disk_full_at(100):
        for _ in range(5):
            bench.clock.t_ns += S
            bench.stick()
        assert bench.reasons() == [Reason.RECORDER_FAILED]
        assert bench.recorder.health().failed
    bench.clock.t_ns += S
    bench.stick()
    assert bench.reasons() == [Reason.RECORDER_FAILED, Reason.RECOVERED]
    bench.recorder.close()
    flight = read_flight(tmp_path / "a.mcap")
    assert len(flight.values("sticks")) == 7
    assert [event.reason for event in flight.events] == bench.reasons()


def test_a_disk_that_stays_full_costs_values_but_no_memory_without_end_and_no_event(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "a.mcap", image_rate_hz=30.0)
    with disk_full_at(100):
        bench.recorder._log._spool._pending += os.urandom(9_000_000)  # as after minutes of refusing
        bench.clock.t_ns += S
        for _ in range(50):
            bench.stick()
        bench.events.publish(Event(bench.clock.t_ns, "test", Reason.LINK_LOST))
    health = bench.recorder.health()
    assert health.dropped == 50
    assert health.lost_events == 0
    assert bench.reasons().count(Reason.RECORDER_FAILED) == 1


def test_a_new_file_is_begun_when_the_old_one_went_with_its_device(tmp_path: Path) -> None:
    bench = Bench(tmp_path / "stick" / "a.mcap")
    bench.stick()
    with disk_full_at(100):
        bench.clock.t_ns += S
        bench.stick()
    (tmp_path / "stick" / "a.mcap").unlink()
    for _ in range(3):
        bench.clock.t_ns += S
        bench.stick()
    bench.recorder.close()
    again = read_flight(bench.recorder.path)
    assert len(again.values("sticks")) >= 2
    assert again.header["mission"] == "forest"
    assert bench.reasons() == [Reason.RECORDER_FAILED, Reason.RECOVERED]


def test_names_are_the_time_and_the_mission_and_never_taken_twice(tmp_path: Path) -> None:
    path = flight_path(tmp_path, "missions/forest.yaml", 1_777_638_600.0)
    assert path.name == "2026-05-01T12-30-00Z_forest.mcap"
    assert flight_path(tmp_path, "forest", 1_777_638_600.0).name == "2026-05-01T12-30-00Z_forest.2.mcap"


def test_two_daemons_of_the_same_second_do_not_share_a_log(tmp_path: Path) -> None:
    """Guards a race: the name was free until the first sync, and both wrote over each other in one file."""
    logs = [FlightLog(flight_path(tmp_path, "forest", 0.0), {"who": str(i)}) for i in range(3)]
    for log in logs:
        log.sync(durable=False)
    assert len({log.path for log in logs}) == 3
    for i, log in enumerate(logs):
        log.close()
        assert read_flight(log.path).header == {"who": str(i)}


def test_a_folder_that_cannot_be_written_still_gets_a_name(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    assert flight_path(tmp_path / "file", "forest", 0.0).parent == tmp_path / "file"


def test_flights_go_where_systemd_says_unless_the_folder_is_absolute(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("LOGS_DIRECTORY", raising=False)
    assert flight_path(Path("flights"), "forest", 0.0).parent == Path("flights")
    monkeypatch.setenv("LOGS_DIRECTORY", str(tmp_path / "log"))
    assert flight_path(Path("flights"), "forest", 0.0).parent == tmp_path / "log" / "flights"
    assert flight_path(tmp_path / "data", "forest", 0.0).parent == tmp_path / "data"


def real_time_recorder(topics: Topics, events: EventLog, path: Path) -> Recorder:
    return Recorder(topics, events, MonotonicClock(), path, {"mission": "x"}, image_rate_hz=None, threaded=True)


async def test_the_thread_writes_everything_before_close_returns(tmp_path: Path) -> None:
    topics, events = Topics.create(), EventLog()
    recorder = real_time_recorder(topics, events, tmp_path / "a.mcap")
    for i in range(500):
        topics.sticks.publish(Sticks(i, i + 1, 1500, 1500, 1500, 1500))
    events.publish(Event(1, "test", Reason.ENGAGED))
    recorder.close()
    topics.sticks.publish(Sticks(0, 0, 0, 0, 0, 0))
    flight = read_flight(tmp_path / "a.mcap")
    assert [sticks.t_ns for sticks in flight.values("sticks")] == list(range(500))
    assert len(flight.events) == 1
    assert flight.damage.finished


async def test_failure_in_the_thread_becomes_an_event_in_the_loop(tmp_path: Path) -> None:
    topics, events = Topics.create(), EventLog()
    told: asyncio.Future[Event] = asyncio.get_running_loop().create_future()
    events.subscribe(lambda event: told.set_result(event))
    (tmp_path / "file").touch()
    recorder = real_time_recorder(topics, events, tmp_path / "file" / "a.mcap")
    event = await asyncio.wait_for(told, 20)
    assert event.reason is Reason.RECORDER_FAILED
    assert "a.mcap" in event.text
    recorder.close()


async def test_a_disk_that_hangs_holds_nobody_up(tmp_path: Path) -> None:
    """A pipe that nobody reads blocks whoever opens it for writing, as a dying disk does."""
    os.mkfifo(tmp_path / "a.mcap")
    topics, events = Topics.create(), EventLog()
    seen: list[Event] = []
    events.subscribe(seen.append)
    recorder = real_time_recorder(topics, events, tmp_path / "a.mcap")
    for i in range(20 * QUEUE_LIMIT):
        topics.sticks.publish(Sticks(i, i + 1, 1500, 1500, 1500, 1500))
        if recorder.health().dropped >= 500:
            break
        await asyncio.sleep(0)
    events.publish(Event(1, "test", Reason.LINK_LOST))
    health = recorder.health()
    assert health.dropped >= 500
    assert health.lost_events == 0
    await asyncio.sleep(0)
    assert Reason.RECORDER_FAILED in [event.reason for event in seen]
    recorder.close(timeout_s=0.01)
    os.close(os.open(tmp_path / "a.mcap", os.O_RDONLY | os.O_NONBLOCK))  # lets the thread go


def test_a_flight_that_never_began_still_makes_a_readable_log(tmp_path: Path) -> None:
    flight = flown(tmp_path, 0.0)[1]
    assert flight.damage.finished
    assert len(flight.events) == 2
