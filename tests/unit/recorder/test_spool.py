"""A full disk loses nothing: bytes wait in memory until it takes them."""

import resource
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from morpheyes_daemon.recorder.spool import Spool


@contextmanager
def disk_full_at(size: int) -> Iterator[None]:
    """Let no file of this process grow beyond `size` bytes: the kernel answers EFBIG, as a full disk ENOSPC."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, handler)


def test_bytes_reach_the_file_on_sync_only(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "new" / "log")
    spool.write(b"abc")
    assert not spool.path.exists()
    assert spool.tell() == 3
    spool.sync(durable=True)
    assert spool.path.read_bytes() == b"abc"
    assert spool.pending_bytes == 0


def test_half_written_tail_is_written_over_when_the_disk_has_room_again(tmp_path: Path) -> None:
    spool = Spool(tmp_path / "log")
    spool.write(b"a" * 600)
    spool.sync(durable=False)
    spool.write(b"b" * 800)
    with disk_full_at(1000), pytest.raises(OSError):
        spool.sync(durable=False)
    spool.write(b"c" * 10)
    assert spool.tell() == 1410
    spool.sync(durable=False)
    assert spool.path.read_bytes() == b"a" * 600 + b"b" * 800 + b"c" * 10


def test_an_older_file_of_that_name_is_replaced(tmp_path: Path) -> None:
    (tmp_path / "log").write_bytes(b"x" * 100)
    spool = Spool(tmp_path / "log")
    spool.write(b"new")
    spool.sync(durable=False)
    assert spool.path.read_bytes() == b"new"


@pytest.mark.parametrize("shorten", [lambda p: p.unlink(), lambda p: p.write_bytes(b"")])
def test_a_file_that_went_away_is_noticed_on_reopening(tmp_path: Path, shorten) -> None:
    spool = Spool(tmp_path / "log")
    spool.write(b"abc")
    spool.sync(durable=False)
    spool.close()
    shorten(spool.path)
    spool.write(b"def")
    with pytest.raises(FileNotFoundError):
        spool.sync(durable=False)
    assert spool.pending_bytes == 3
