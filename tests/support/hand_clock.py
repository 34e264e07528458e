"""A clock that a test sets by hand."""

from morpheyes_daemon.clock import S


class HandClock:
    """Time stands still until the test moves `t_ns`; nothing may sleep on it."""

    def __init__(self) -> None:
        self.t_ns = 1000 * S

    def now_ns(self) -> int:
        return self.t_ns

    async def sleep_until_ns(self, t_ns: int) -> None:
        raise AssertionError("nothing sleeps on a clock that is set by hand")
