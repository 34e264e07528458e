"""Logs are read back whole after SIGKILL, and as far as possible when damaged."""

import subprocess
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.exceptions import McapError
from mcap.reader import make_reader

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.recorder.reader import read_flight, recover
from morpheyes_daemon.recorder.recorder import Recorder
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight

KILLED_WRITER = """
import os, signal, sys
from pathlib import Path
sys.path.insert(0, ".")
from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.recorder.recorder import Recorder
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight
topics, events, clock = Topics.create(), EventLog(), HandClock()
recorder = Recorder(topics, events, clock, Path(sys.argv[1]), {"mission": "forest"}, image_rate_hz=2.0,
                    threaded=False)
SyntheticFlight(topics, events, clock).fly(60.4)
print(recorder.health().written, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The log of a writer that was killed in its sixtieth second, and how many messages it had been given."""
    path = tmp_path_factory.mktemp("killed") / "flight.mcap"
    done = subprocess.run([sys.executable, "-c", KILLED_WRITER, str(path)], capture_output=True, text=True)
    assert done.returncode == -9, done.stderr
    return path, int(done.stdout)


def test_nearly_everything_survives_sigkill(killed: tuple[Path, int]) -> None:
    path, written = killed
    flight = read_flight(path)
    assert len(flight.records) >= 0.97 * written
    assert not flight.damage.finished
    assert flight.damage.bad_chunks == 0
    assert flight.header["mission"] == "forest"


def test_recover_makes_a_log_that_every_tool_opens(killed: tuple[Path, int], tmp_path: Path) -> None:
    path, written = killed
    with path.open("rb") as stream, pytest.raises((McapError, ValueError)):
        make_reader(stream).get_summary()
    saved = recover(path, tmp_path / "saved.mcap")
    assert saved.messages >= 0.97 * written
    assert not saved.was_finished
    with (tmp_path / "saved.mcap").open("rb") as stream:
        summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert summary.statistics.message_count == saved.messages
    again = read_flight(tmp_path / "saved.mcap")
    assert again.damage.finished
    assert [r.value for r in again.records if r.topic == "sticks"] == read_flight(path).values("sticks")


def test_recover_never_overwrites(killed: tuple[Path, int], tmp_path: Path) -> None:
    (tmp_path / "there.mcap").write_text("mine")
    with pytest.raises(InputError, match="there already"):
        recover(killed[0], tmp_path / "there.mcap")
    assert (tmp_path / "there.mcap").read_text() == "mine"


@cache
def whole_log() -> bytes:
    with TemporaryDirectory() as folder:
        topics, events, clock = Topics.create(), EventLog(), HandClock()
        path = Path(folder) / "a.mcap"
        recorder = Recorder(topics, events, clock, path, {"mission": "x"}, image_rate_hz=None, threaded=False)
        SyntheticFlight(topics, events, clock, images=False).fly(4.0)
        recorder.close()
        return path.read_bytes()


@given(st.floats(0.01, 0.999))
@settings(max_examples=40, deadline=None)
def test_a_log_cut_anywhere_is_read_up_to_the_cut(share: float) -> None:
    whole = whole_log()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "cut.mcap"
        path.write_bytes(whole[: 8 + round(share * (len(whole) - 8))])
        flight = read_flight(path)
    assert flight.damage.bad_messages == 0
    times = [record.log_ns for record in flight.records]
    assert times == sorted(times)


@given(st.lists(st.tuples(st.floats(0.0, 0.9999), st.integers(1, 255)), min_size=1, max_size=6))
@settings(max_examples=100, deadline=None)
def test_flipped_bytes_never_raise_anything_but_a_sentence(flips: list[tuple[float, int]]) -> None:
    damaged = bytearray(whole_log())
    for share, mask in flips:
        damaged[int(share * len(damaged))] ^= mask
    with TemporaryDirectory() as folder:
        path, out = Path(folder) / "a.mcap", Path(folder) / "b.mcap"
        path.write_bytes(damaged)
        with suppress(InputError):
            flight = read_flight(path)
            recover(path, out)
            # what is left of it can be read as what it is, damage and all
            assert len(read_flight(out).records) == len(flight.records)


@pytest.mark.parametrize("content", [b"", b"MCAP", b"not a log at all, just text"])
def test_other_files_are_refused_with_a_sentence(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match="is not a flight log"):
        read_flight(path)


def test_missing_and_unreadable_files_are_refused_with_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="No such file"):
        read_flight(tmp_path / "none.mcap")
    with pytest.raises(InputError, match="directory"):
        read_flight(tmp_path)
