"""Progress line of a simulated flight, on standard error."""

from __future__ import annotations

from types import TracebackType
from typing import TYPE_CHECKING, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from morpheyes_daemon.flights.lockstep import Progress as FlightProgress


class FlightLine:
    """A bar of the distance to the goal with state, speed and baseline; hidden when `quiet`."""

    def __init__(self, quiet: bool) -> None:
        self._progress = Progress(
            TextColumn("{task.fields[state]:<10}"),
            BarColumn(bar_width=40),
            TextColumn("{task.fields[figures]}"),
            TimeElapsedColumn(),
            console=Console(stderr=True),
            disable=quiet,
        )
        self._task = self._progress.add_task("", total=1.0, state="building", figures="world and textures")
        self._whole_m = 0.0

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def show(self, at: FlightProgress) -> None:
        """Show the progress of the flight."""
        self._whole_m = max(self._whole_m, at.distance_m, 1e-3)
        figures = (
            f"{at.simulated_s:5.1f} s  {at.distance_m:5.1f} m to go  {at.speed_m_s:4.2f} m/s"
            f"  baseline {at.baseline_m * 1e3:3.0f} mm"
        )
        done = max(0.0, 1.0 - at.distance_m / self._whole_m)
        self._progress.update(self._task, completed=done, state=at.phase, figures=figures)

    def show_step(self, text: str) -> None:
        """Show a step before or after the flight."""
        self._progress.update(self._task, figures=text)
