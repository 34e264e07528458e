"""The strips of a flight: depth, baseline, speed, sticks and state over one time axis.

What was not recorded leaves its panel empty.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.messages.safety import State
from morpheyes_daemon.recorder.series import FlightSeries
from morpheyes_daemon.stereo.colours import MAX_BASELINE_M, MIN_BASELINE_M

Column = NDArray[np.float64]

WIDTH_IN, HEIGHT_IN, DPI = 12.0, 8.6, 150
BLUE, ORANGE, GREEN, RED, GREY, INK = "#1f6fb4", "#e07b00", "#2b8a3e", "#b3123a", "#9aa1ab", "#30343a"
DEPTH_SHOWN_M = 20.0
STATE_COLOURS: dict[State, str] = {
    State.BOOT: "#dfe3e8",
    State.PREFLIGHT: "#dfe3e8",
    State.STANDBY: "#c8d9ea",
    State.ENGAGED: "#bfe3c4",
    State.BRAKING: "#f6b8a6",
    State.HOLD: "#f7dd9c",
    State.PILOT: "#d9cdf0",
    State.RELEASED: "#d9cdf0",
    State.FAULT: "#ef8a8a",
}


def draw_strips(out: Path, series: FlightSeries, *, title: str = "") -> None:
    """Write the strips of `series` as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), dpi=DPI, facecolor="white")
    FigureCanvasAgg(figure)
    rows = figure.subplots(5, 1, sharex=True, gridspec_kw={"height_ratios": [2.2, 1.8, 1.8, 1.8, 0.55]})
    for axes, draw in zip(rows, (_depth, _baseline, _speed, _sticks, _state), strict=True):
        draw(axes, series)
        _quiet(axes)
    for axes in rows[:-1]:
        _shade_braking(axes, series)
        if axes.get_legend_handles_labels()[0]:
            axes.legend(loc="upper left", bbox_to_anchor=(1.005, 1.0), fontsize=8.5, frameon=False, borderaxespad=0)
    rows[0].set_xlim(0.0, max(series.duration_s, 1e-3))
    rows[0].set_title(title, fontsize=10, loc="left")
    rows[-1].set_xlabel("time [s]", fontsize=9)
    figure.subplots_adjust(left=0.065, right=0.845, top=0.955, bottom=0.06, hspace=0.14)
    figure.align_ylabels(rows)
    figure.savefig(out)


def _quiet(axes: Any) -> None:
    axes.tick_params(labelsize=8, length=3, color="#888888")
    axes.grid(axis="both", color="#e6e8eb", linewidth=0.7)
    axes.set_axisbelow(True)
    for name, spine in axes.spines.items():
        spine.set_visible(name in ("left", "bottom"))
        spine.set_color("#888888")


def _line(axes: Any, series: FlightSeries, topic: str, name: str, scale: float = 1.0, **style: Any) -> Column:
    """Plot one column; returns its values, empty when nothing was recorded."""
    values = scale * series.column(topic, name)
    if values.size:
        axes.plot(series.times_s(topic), np.where(np.isfinite(values), values, np.nan), **style)
    return values


def _depth(axes: Any, series: FlightSeries) -> None:
    near = series.column("perception", "near_limit_m")
    trust, times = series.column("governed", "trust_m"), series.times_s("governed")
    top = _shown(trust, series.column("command", "z_close_m"))
    if trust.size:
        axes.fill_between(times, 0, np.clip(np.nan_to_num(trust), 0, top), color="#dceaf6", label="trusted depth")
    if near.size:
        axes.fill_between(series.times_s("perception"), 0, near, color="#c9ced6", label="too near to match", zorder=2)
    _line(axes, series, "command", "clear_m", color=GREEN, linewidth=1.0, label="known free ahead")
    _line(axes, series, "command", "z_close_m", color=BLUE, linewidth=1.6, label="nearest, $Z_{close}$")
    axes.set_ylim(0, top)
    axes.set_ylabel("depth [m]", fontsize=9)


def _shown(*columns: Column) -> float:
    """The top of the depth axis: what nearly all values stay under, between 5 m and `DEPTH_SHOWN_M`."""
    values = np.concatenate([c[np.isfinite(c)] for c in columns])
    return float(np.clip(1.1 * np.percentile(values, 98), 5.0, DEPTH_SHOWN_M)) if values.size else 5.0


def _baseline(axes: Any, series: FlightSeries) -> None:
    times, baseline = series.times_s("baseline"), 1e3 * series.column("baseline", "baseline_m")
    sigma = 3e3 * series.column("baseline", "sigma_m")
    if baseline.size:
        axes.fill_between(times, baseline - sigma, baseline + sigma, color="#f6d9b3", label="±3σ")
    _line(axes, series, "baseline", "target_m", 1e3, color=GREY, linewidth=1.2, label="target")
    _line(axes, series, "baseline", "baseline_m", 1e3, color=ORANGE, linewidth=1.6, label="modelled")
    low = min(1e3 * MIN_BASELINE_M, *baseline, np.inf)
    high = max(1e3 * MAX_BASELINE_M, *baseline, 0.0)
    axes.set_ylim(low - 15, high + 15)
    axes.set_ylabel("baseline [mm]", fontsize=9)


def _speed(axes: Any, series: FlightSeries) -> None:
    _line(axes, series, "governed", "limit_m_s", color=RED, linewidth=1.2, label="governor's limit")
    _line(axes, series, "governed", "wanted_m_s", color=GREY, linewidth=1.0, label="wanted by mission")
    v = series.column("vehicle", "v_ned_m_s").reshape(-1, 3)
    if v.size:
        speed = np.hypot(v[:, 0], v[:, 1])
        axes.plot(series.times_s("vehicle"), speed, color=INK, linewidth=1.6, label="flown")
    axes.set_ylim(bottom=0)
    axes.set_ylabel("speed [m/s]", fontsize=9)


def _sticks(axes: Any, series: FlightSeries) -> None:
    times = series.times_s("gate")
    for name, colour in (("roll", GREEN), ("pitch", BLUE), ("throttle", GREY), ("yaw", ORANGE)):
        width = series.column("gate", f"{name}_us")
        if width.size:
            axes.plot(times, np.where(width > 0, width, np.nan), color=colour, linewidth=1.1, label=name)
    axes.set_ylabel("sticks [µs]", fontsize=9)


def _state(axes: Any, series: FlightSeries) -> None:
    seen: set[str] = set()
    for start_s, end_s, state in series.spans("gate", "state"):
        colour = STATE_COLOURS.get(State(state), "#dfe3e8") if state in set(State) else "#dfe3e8"
        axes.axvspan(start_s, end_s, color=colour, linewidth=0)
        if end_s - start_s > 0.07 * series.duration_s:
            axes.text((start_s + end_s) / 2, 0.5, state, ha="center", va="center", fontsize=8.5, color=INK)
        seen.add(state)
    for event in series.events:
        axes.axvline(series.seconds(event.t_ns), color=INK if event.reason.number < 40 else RED, linewidth=0.9)
    axes.set_ylim(0, 1)
    axes.set_yticks([])
    axes.set_ylabel("state", fontsize=9)


def _shade_braking(axes: Any, series: FlightSeries) -> None:
    for start_s, end_s, state in series.spans("gate", "state"):
        if state == State.BRAKING:
            axes.axvspan(start_s, end_s, color="#f6b8a6", alpha=0.35, linewidth=0, zorder=0)
