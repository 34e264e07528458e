"""Virtual time: it passes without waiting, in an order that does not depend on the machine."""

import asyncio

import pytest

from morpheyes_daemon.clock import MS, S, Ticker, VirtualClock, run_virtual, running_clock


def test_an_hour_passes_at_once_and_to_the_nanosecond() -> None:
    async def sleep() -> int:
        clock = running_clock()
        before_ns = clock.now_ns()
        await clock.sleep_until_ns(before_ns + 3600 * S)
        return clock.now_ns() - before_ns

    assert abs(run_virtual(sleep()) - 3600 * S) <= 1000  # float seconds of the loop's own clock


def test_tickers_interleave_the_same_way_every_time() -> None:
    async def interleave() -> list[tuple[str, int]]:
        clock = running_clock()
        seen: list[tuple[str, int]] = []

        async def beat(name: str, rate_hz: float, count: int) -> None:
            ticker = Ticker(clock, rate_hz)
            for _ in range(count):
                await ticker.wait()
                seen.append((name, clock.now_ns()))

        await asyncio.gather(beat("sticks", 50.0, 25), beat("camera", 5.0, 3), beat("health", 4.0, 2))
        return seen

    first, second = run_virtual(interleave()), run_virtual(interleave())
    assert first == second
    assert [name for name, _ in first].count("sticks") == 25


def test_a_ticker_skips_what_it_missed() -> None:
    async def late() -> tuple[int, int]:
        clock = running_clock()
        ticker = Ticker(clock, 50.0)
        await clock.sleep_until_ns(clock.now_ns() + 310 * MS)
        late_ns = await ticker.wait()
        before_ns = clock.now_ns()
        await ticker.wait()
        return late_ns, clock.now_ns() - before_ns

    late_ns, next_ns = run_virtual(late())
    assert 289 * MS <= late_ns <= 291 * MS
    assert 0 < next_ns <= 20 * MS


def test_waiting_for_nothing_is_an_error_not_a_hang() -> None:
    async def forever() -> None:
        await asyncio.get_running_loop().create_future()

    with pytest.raises(RuntimeError, match="virtual time cannot pass"):
        run_virtual(forever())


def test_the_running_clock_is_virtual_on_a_virtual_loop() -> None:
    async def kind() -> type:
        return type(running_clock())

    assert run_virtual(kind()) is VirtualClock
