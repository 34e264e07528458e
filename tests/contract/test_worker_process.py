"""The worker process: big frames, exceptions, hangs, kills, restarts, and nothing left behind."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from morpheyes_daemon.clock import MS, run_virtual, running_clock
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.messages.core import BaselineEstimate, StereoFrame
from morpheyes_daemon.vision_worker.inline import InlineWorker, WorkerFailed, WorkerLost
from morpheyes_daemon.vision_worker.process import ProcessWorker
from morpheyes_daemon.vision_worker.shared_memory import Mailbox
from tests.safety.scapegoat import Order, Scapegoat, dies_building, never_built

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="the worker needs Unix sockets")


@asynccontextmanager
async def worker(job_timeout_s: float = 30.0, **kwargs: Any) -> AsyncIterator[ProcessWorker[Order, Any]]:
    made: ProcessWorker[Order, Any] = ProcessWorker(Scapegoat, job_timeout_s=job_timeout_s, **kwargs)
    await made.start()
    try:
        yield made
    finally:
        await made.close()
        await made.close()


def gone(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return True
    return False


async def until(condition: Callable[[], bool]) -> None:
    """Wait for another process; there is nothing to be notified by."""
    while not condition():  # noqa: ASYNC110
        await asyncio.sleep(0.01)


async def test_it_computes_elsewhere_and_nicely() -> None:
    async with worker(niceness=7) as w:
        assert await w.compute(Order("pid")) == w.pid != os.getpid()
        assert await w.compute(Order("nice")) == min(19, os.nice(0) + 7)
        assert await w.compute(Order("count")) == 3
        pid = w.pid
    assert pid is not None
    assert gone(pid)


UNDER_A_FILTER = """
import asyncio, os
from morpheyes_daemon.vision_worker.process import ProcessWorker
from tests.safety.scapegoat import Order, Scapegoat

async def main():
    remarks = []
    worker = ProcessWorker(Scapegoat, job_timeout_s=30.0, niceness=7, on_remark=remarks.append)
    await worker.start()
    assert await worker.compute(Order("nice")) == os.getpriority(os.PRIO_PROCESS, 0)
    os.kill(worker.pid, 9)
    while worker.restarts == 0:
        await asyncio.sleep(0.01)
    assert await worker.compute(Order("count")) == 1
    await worker.close()
    print(*remarks, sep="\\n")

if __name__ == "__main__":
    asyncio.run(main())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="seccomp is Linux's")
def test_a_refused_priority_is_said_once_and_the_worker_works(tmp_path: Path) -> None:
    """A unit's SystemCallFilter=~@resources answers setpriority with EPERM."""
    script, root = tmp_path / "under_a_filter.py", Path(__file__).parents[2]
    script.write_text(UNDER_A_FILTER)
    done = subprocess.run(
        [sys.executable, root / "tests/support/refused_call.py", "setpriority", sys.executable, script],
        capture_output=True, text=True, timeout=120, env={**os.environ, "PYTHONPATH": str(root)},
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    (remark,) = done.stdout.splitlines()
    assert "Operation not permitted" in remark
    assert "setpriority" in remark


async def test_big_frames_pass_both_ways_unchanged() -> None:
    noise = np.random.default_rng(1)
    async with worker() as w:
        for size in ((120, 160), (1536, 2048, 3), (480, 640, 3)):
            images = [noise.integers(0, 255, size, dtype=np.uint8) for _ in range(2)]
            frame = StereoFrame(4, 5, images[0], images[1], BaselineEstimate(1, 0.2, 0.2, 0.0, False))
            back = await w.compute(Order("echo", frame))
            assert (back.seq, back.t_ns, back.baseline) == (frame.seq, frame.t_ns, frame.baseline)
            np.testing.assert_array_equal(back.left, frame.left)
            np.testing.assert_array_equal(back.right, frame.right)
            assert not back.left.flags.writeable
        assert await w.compute(Order("read_only", images[0]))
        crop = images[0][:, 100:300]  # not contiguous
        np.testing.assert_array_equal(await w.compute(Order("echo", crop)), crop)


async def test_an_exception_inside_is_told_and_the_worker_lives_on() -> None:
    async with worker() as w:
        pid = w.pid
        with pytest.raises(CalibrationError, match=r"^baseline 0\.4 m is outside$"):
            await w.compute(Order("refuse", "baseline 0.4 m is outside"))
        with pytest.raises(WorkerFailed, match="ZeroDivisionError: by zero") as caught:
            await w.compute(Order("fail", "by zero"))
        assert "in fail" in caught.value.remote_traceback
        with pytest.raises(WorkerFailed, match="pickle"):
            await w.compute(Order("unpicklable"))
        assert await w.compute(Order("count")) == 4
        assert (w.pid, w.restarts) == (pid, 0)


async def test_a_hung_worker_is_killed_and_replaced_while_the_loop_runs_on() -> None:
    turns = 0

    async def count_turns() -> None:
        nonlocal turns
        while True:
            await asyncio.sleep(0.01)
            turns += 1

    async with worker(job_timeout_s=2.0) as w:
        pid = w.pid
        assert pid is not None
        counter = asyncio.create_task(count_turns())
        with pytest.raises(WorkerLost, match=r"within 2 s and was killed"):
            await w.compute(Order("hang"))
        counter.cancel()
        assert turns > 10  # of 200: a blocked loop would have counted none
        assert await w.compute(Order("count")) == 1
        assert w.restarts == 1
        assert w.pid != pid
        assert gone(pid)


async def test_a_worker_that_dies_at_work_is_replaced() -> None:
    deaths = [
        (Order("crash", signal.SIGKILL), "killed by SIGKILL"),
        (Order("crash", signal.SIGSEGV), "killed by SIGSEGV"),
        (Order("leave", 3), "exit code 3"),
    ]
    told: list[str] = []
    async with worker(on_idle_death=told.append) as w:
        for number, (order, end) in enumerate(deaths):
            with pytest.raises(WorkerLost, match=end):
                await w.compute(order)
            assert await w.compute(Order("count")) == 1
            assert w.restarts == number + 1
    assert told == []  # who waited for the job has been told by its exception


async def test_a_worker_killed_while_idle_is_replaced_unasked_and_told_of() -> None:
    told: list[str] = []
    async with worker(on_idle_death=told.append) as w:
        pid = w.pid
        assert pid is not None
        os.kill(pid, signal.SIGKILL)
        await until(lambda: w.pid not in (pid, None))
        assert told == ["The vision worker died while idle (killed by SIGKILL); a new one is being started."]
        assert w.restarts == 1
        assert await w.compute(Order("count")) == 1


async def test_a_cancelled_caller_leaves_the_worker_fit_for_the_next() -> None:
    async with worker() as w:
        waiting = asyncio.create_task(w.compute(Order("fail", "for nobody")))
        await asyncio.sleep(0)
        await asyncio.sleep(0)
        waiting.cancel()
        with pytest.raises(asyncio.CancelledError):
            await waiting
        assert await w.compute(Order("echo", "for me")) == "for me"


async def test_ctrl_c_does_not_reach_the_worker() -> None:
    async with worker() as w:
        assert w.pid is not None
        os.kill(w.pid, signal.SIGINT)
        assert await w.compute(Order("count")) == 1
        assert w.restarts == 0


async def test_a_factory_that_raises_says_why() -> None:
    made: ProcessWorker[Order, Any] = ProcessWorker(never_built, job_timeout_s=1)
    with pytest.raises(CalibrationError, match=r"calibration\.yaml: there is no such file"):
        await made.start()
    await made.close()


async def test_a_worker_that_died_while_starting_starts_on_the_next_call(tmp_path: Path) -> None:
    made: ProcessWorker[Order, Any] = ProcessWorker(partial(dies_building, tmp_path / "tried"), job_timeout_s=30)
    with pytest.raises(WorkerLost, match="exit code 9"):
        await made.start()
    assert await made.compute(Order("count")) == 1
    await made.close()


async def test_a_closed_worker_refuses_work() -> None:
    async with worker() as w:
        pass
    with pytest.raises(WorkerLost, match="closed"):
        await w.compute(Order("count"))


async def test_nothing_is_left_open() -> None:
    async def use() -> None:
        async with worker(job_timeout_s=2.0) as w:
            await w.compute(Order("echo", np.zeros(1 << 20, np.uint8)))
            with pytest.raises(WorkerLost):
                await w.compute(Order("hang"))
            await w.compute(Order("count"))

    await use()  # the first use starts what Python itself keeps: thread pool, resource tracker
    before = sorted(os.readlink(f"/proc/self/fd/{fd}").partition(":")[0] for fd in _open_fds())
    await use()
    after = sorted(os.readlink(f"/proc/self/fd/{fd}").partition(":")[0] for fd in _open_fds())
    assert after == before


def _open_fds() -> list[str]:
    listing = Path("/proc/self/fd")
    if not listing.is_dir():
        pytest.skip("no /proc to count descriptors in")
    return [fd for fd in os.listdir(listing) if (listing / fd).exists() or (listing / fd).is_symlink()]


ORPHAN = """
import asyncio, os, signal
from tests.safety.scapegoat import Order, Scapegoat
from morpheyes_daemon.vision_worker.process import ProcessWorker

async def main():
    worker = ProcessWorker(Scapegoat, job_timeout_s=60)
    await worker.start()
    asyncio.create_task(worker.compute(Order("hang")))
    await asyncio.sleep(0.1)
    print(worker.pid, flush=True)
    os.kill(os.getpid(), signal.SIGKILL)

if __name__ == "__main__":
    asyncio.run(main())
"""


async def test_the_worker_ends_with_its_parent_even_while_it_hangs(tmp_path: Path) -> None:
    script = tmp_path / "parent.py"
    script.write_text(ORPHAN)
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])}
    parent = await asyncio.create_subprocess_exec(sys.executable, str(script), stdout=subprocess.PIPE, env=environment)
    out, _ = await parent.communicate()
    assert parent.returncode == -signal.SIGKILL
    await until(lambda: gone(int(out)))


def test_mailboxes_grow_and_shrink_with_their_content() -> None:
    ours = Mailbox.create()
    theirs = Mailbox(os.dup(ours.fd))
    for length in (10, 3_000_000, 5, 8_000_000):
        ours.put({"a": np.arange(length), "b": "text"})
        taken = theirs.take()
        assert taken["b"] == "text"
        np.testing.assert_array_equal(taken["a"], np.arange(length))
    ours.close()
    theirs.close()
    theirs.close()


def test_the_inline_worker_answers_after_its_latency() -> None:
    async def scene() -> None:
        clock = running_clock()
        began_ns = clock.now_ns()
        inline: InlineWorker[int, int] = InlineWorker(lambda job: job * 2, 100 * MS, clock)
        await inline.start()
        assert await inline.compute(21) == 42
        assert clock.now_ns() - began_ns == pytest.approx(100 * MS, abs=1000)  # float seconds in the loop
        await inline.close()

    run_virtual(scene())
