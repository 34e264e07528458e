"""The paper's figures 2, 3 and 5, table I and the depth error, drawn from `theory_analysis`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from morpheyes_daemon.paper.error_analysis import (
    DEPTHS_M,
    DISPARITY_ERROR_PX,
    SYNC_DT_S,
    SYNC_K_PX,
    SYNC_Z_M,
    Subject,
)
from morpheyes_daemon.stereo.colours import baseline_bgr
from morpheyes_daemon.theory.calibration_error import nominal

DPI = 150
INK, GREY, GRID = "#30343a", "#888888", "#e6e8eb"
PALETTE = ("#1f6fb4", "#e07b00", "#2b8a3e", "#b3123a", "#7a4fb0", "#30343a")

SYMBOLS = {
    "f": "f",
    "alpha": r"\alpha",
    "k1": "k_1",
    "k2": "k_2",
    "k3": "k_3",
    "k4": "k_4",
    "k5": "k_5",
    "T": "T_x",
    "phi": r"\phi",
    "theta": r"\theta",
    "psi": r"\psi",
}
FIGURE_2 = (("f", "y"), ("alpha", "x"), ("k1", "x"), ("k2", "y"), ("k3", "y"), ("k5", "y"), ("k4", "x"))
"""Which error the paper's figure 2 shows in its panels (a) to (f), and k4, which it leaves out."""


def draw_all(out: Path, subject: Subject, numbers: dict[str, Any]) -> list[Path]:
    """Write every figure as a PNG into `out` and return their paths."""
    drawings: dict[str, Callable[[Subject, dict[str, Any]], Any]] = {
        "depth_error.png": _depth_error,
        "intrinsic_errors.png": _intrinsic_errors,
        "extrinsic_errors.png": _extrinsic_errors,
        "table_1.png": _table_1,
        "sync_bounds.png": _sync_bounds,
    }
    paths = []
    for name, draw in drawings.items():
        draw(subject, numbers).savefig(out / name)
        paths.append(out / name)
    return paths


def _figure(width_in: float, height_in: float, title: str, subtitle: str) -> Any:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.layout_engine import ConstrainedLayoutEngine

    layout = ConstrainedLayoutEngine(
        w_pad=0.1, h_pad=0.1, wspace=0.03, hspace=0.04, rect=(0, 0, 1, 1 - 0.62 / height_in)
    )
    figure = Figure(figsize=(width_in, height_in), dpi=DPI, facecolor="white", layout=layout)
    FigureCanvasAgg(figure)
    left = 0.14 / width_in
    figure.text(left, 1 - 0.12 / height_in, title, va="top", fontsize=13, color=INK, fontweight="bold")
    figure.text(left, 1 - 0.40 / height_in, subtitle, va="top", fontsize=9, color=GREY)
    return figure


def _quiet(axes: Any, x: str, y: str, title: str = "") -> None:
    axes.tick_params(labelsize=8, length=3, color=GREY)
    axes.grid(color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(GREY)
    axes.set_xlabel(x, fontsize=9, color=INK)
    axes.set_ylabel(y, fontsize=9, color=INK)
    axes.set_title(title, fontsize=10, color=INK, loc="left")


def _legend(axes: Any, title: str, **options: Any) -> None:
    axes.legend(title=title, fontsize=8, title_fontsize=8, frameon=False, labelcolor=INK, **options)


def _colour(index: int, label: str) -> Any:
    if label.endswith(" mm") and label[:-3].isdigit() and float(label[:-3]) >= 50:
        return tuple(c / 255 for c in reversed(baseline_bgr(float(label[:-3]) / 1e3)))
    return PALETTE[index % len(PALETTE)]


def _depth_error(subject: Subject, numbers: dict[str, Any]) -> Any:
    figure = _figure(
        10.0, 4.6, "Depth error over depth", f"ε_z = z² ε_d / (b f), ε_d = {DISPARITY_ERROR_PX} px, "
        f"f = {subject.f_px:.0f} px; each curve begins at the near limit of {subject.num_disparities} disparities",
    )  # fmt: skip
    absolute, relative = figure.subplots(1, 2)
    import numpy as np

    shown = sorted({subject.baselines_m[0], subject.baselines_m[len(subject.baselines_m) // 2], subject.baselines_m[-1]})
    for b in shown:
        z = np.geomspace(b * subject.f_px / subject.num_disparities, DEPTHS_M[-1], 100)
        error = z**2 * DISPARITY_ERROR_PX / (b * subject.f_px)
        colour = tuple(c / 255 for c in reversed(baseline_bgr(b)))
        for axes, values in ((absolute, error), (relative, 100 * error / z)):
            axes.plot(z, values, color=colour, linewidth=2, label=f"{b * 1e3:.0f} mm")
            axes.plot(z[0], values[0], "o", color=colour, markersize=5)
    absolute.set_xscale("log")
    absolute.set_yscale("log")
    absolute.set_xticks([0.2, 0.5, *DEPTHS_M])
    for axes in (absolute, relative):
        axes.set_xlim(0.8 * subject.baselines_m[0] * subject.f_px / subject.num_disparities, DEPTHS_M[-1])
        axes.xaxis.set_major_formatter("{x:g}")
    absolute.yaxis.set_major_formatter("{x:g}")
    relative.set_ylim(bottom=0)
    _quiet(absolute, "depth z [m]", "depth error [m]", "in metres")
    _quiet(relative, "depth z [m]", "depth error / depth [%]", "relative")
    _legend(absolute, "baseline", loc="upper left")
    return figure


def _intrinsic_errors(subject: Subject, numbers: dict[str, Any]) -> Any:
    figure = _figure(
        13.5, 6.6, "Pixel error for an error in one intrinsic number (paper, figure 2)",
        f"{subject.name}; largest error in the image; scales differ from panel to panel",
    )  # fmt: skip
    panels = figure.subplots(2, 4)
    rows = numbers["calibration_error"]["intrinsic"]
    labels = list(subject.lenses)
    for axes, letter, (name, direction) in zip(panels.flat[:-1], "abcdefg", FIGURE_2, strict=True):
        for row in (row for row in rows if row["parameter"] == name):
            index = labels.index(row["lens"])
            axes.plot(
                row["error_pct"], row[f"e_{direction}_px"], color=_colour(index, ""), linewidth=1.8, label=row["lens"]
            )
        _begin_at_zero(axes)
        values = {nominal(lens, name) for lens in subject.lenses.values()}
        of = "" if name == "f" else f" of {values.pop():.3g}" if len(values) == 1 else " of its own"
        _quiet(axes, f"error of ${SYMBOLS[name]}$ [%{of}]", f"$e_{direction}$ [px]", f"({letter})  ${SYMBOLS[name]}$")
    handles, _ = panels[0, 2].get_legend_handles_labels()
    panels[1, 3].set_axis_off()
    _legend(panels[1, 3], "focal length" if "mm" in labels[0] else "", loc="center left", handles=handles)
    return figure


def _extrinsic_errors(subject: Subject, numbers: dict[str, Any]) -> Any:
    figure = _figure(
        11.0, 9.6, "Pixel error in the right image for an error in one extrinsic number (paper, figure 3)",
        f"{subject.name}; largest error in the image; scales differ from panel to panel",
    )  # fmt: skip
    panels = figure.subplots(4, 2)
    rows = numbers["calibration_error"]["extrinsic"]
    labels = list(subject.pairs)
    letters = iter("abcdefgh")
    for line, name in zip(panels, ("T", "phi", "theta", "psi"), strict=True):
        key, unit = ("error_pct", "%") if name == "T" else ("error_deg", "°")
        for axes, direction in zip(line, "xy", strict=True):
            for row in (row for row in rows if row["parameter"] == name):
                colour = _colour(labels.index(row["pair"]), row["pair"])
                axes.plot(row[key], row[f"e_{direction}_px"], color=colour, linewidth=1.8, label=row["pair"])
            _begin_at_zero(axes)
            _quiet(axes, f"error of ${SYMBOLS[name]}$ [{unit}]", f"$e_{{{direction},R}}$ [px]",
                   f"({next(letters)})  $e_{{{direction},R}}$ from ${SYMBOLS[name]}$")  # fmt: skip
    _legend(panels[0, 0], "baseline" if subject.pairs.keys() != subject.lenses.keys() else "focal length",
            loc="center left", bbox_to_anchor=(1.0, 0.5))  # fmt: skip
    return figure


def _begin_at_zero(axes: Any) -> None:
    """Start both axes at zero, and say so where one line hides the others."""
    axes.set_xlim(left=0)
    axes.set_ylim(bottom=0)
    ends = [float(line.get_ydata()[-1]) for line in axes.get_lines()]
    if len(ends) > 1 and max(ends) - min(ends) < 0.03 * max(ends):
        axes.text(0.97, 0.06, "the same for all", transform=axes.transAxes, ha="right", fontsize=8, color=GREY)


def _table_1(subject: Subject, numbers: dict[str, Any]) -> Any:
    table = numbers["table_1"]
    figure = _figure(8.4, 3.5, "Table I: how errors in x and y relate", f"{subject.name}; {table['statistic']}")
    axes = figure.subplots()
    axes.axis("off")
    intrinsic, extrinsic = table["intrinsic"], table["extrinsic"]
    rows = [
        ["intrinsic", *(f"${SYMBOLS[name]}$" for name in intrinsic)],
        ["$e_y\\,/\\,e_x$", *(f"{value:.3g}" for value in intrinsic.values())],
        ["extrinsic", *(f"${SYMBOLS[name]}$" for name in extrinsic["x"]), "", ""],
        ["$e_{x,L}\\,/\\,e_{x,R}$", *(f"{value:.3g}" for value in extrinsic["x"].values()), "", ""],
        ["$e_{y,L}\\,/\\,e_{y,R}$", *(f"{value:.3g}" for value in extrinsic["y"].values()), "", ""],
    ]
    drawn = axes.table(rows, cellLoc="center", bbox=(0.0, 0.02, 1.0, 0.94))
    drawn.auto_set_font_size(False)
    drawn.set_fontsize(11)
    for (row, column), cell in drawn.get_celld().items():
        cell.visible_edges = "B" if row in (0, 2) else "T" if row == 0 else ""
        cell.set_edgecolor(GREY)
        cell.get_text().set_color(INK if row not in (0, 2) else GREY)
        cell.get_text().set_horizontalalignment("left" if column == 0 else "center")
    return figure


def _sync_bounds(subject: Subject, numbers: dict[str, Any]) -> Any:
    figure = _figure(
        11.0, 4.9, "Largest speed for a disparity error of 1 px (paper, figure 5)",
        f"point at Z = {SYNC_Z_M:g} m, k = {SYNC_K_PX:g} px, f = {subject.f_px:.0f} px, δt between the eyes",
    )  # fmt: skip
    printed, cases = figure.subplots(1, 2)
    for i, dt in enumerate(SYNC_DT_S):
        rows = [row for row in numbers["sync"] if row["dt_s"] == dt]
        style = {"color": PALETTE[i], "linewidth": 1.8, "label": f"{dt * 1e3:g} ms"}
        printed.plot([1e3 * row["baseline_m"] for row in rows], [row["v_max_m_s"] for row in rows], **style)
    printed.set_yscale("log")
    printed.yaxis.set_major_formatter("{x:g}")
    _quiet(printed, "baseline [mm]", "largest speed [m/s]", "as printed in the paper: receding, on the axis")
    _legend(printed, "δt", loc="center left", bbox_to_anchor=(1.0, 0.5))
    rows = [row for row in numbers["sync_cases"] if row["dt_s"] == 2e-3]
    directions = {"receding": "receding, on the axis", "approaching": "approaching, on the axis",
                  "sideways": "sideways", "whole_image": "forwards, whole image"}  # fmt: skip
    for i, (key, label) in enumerate(directions.items()):
        values = [row[f"{key}_m_s"] for row in rows]
        cases.plot([1e3 * row["baseline_m"] for row in rows], values, color=PALETTE[i], linewidth=1.8, label=label)
    cases.set_ylim(bottom=0)
    yaw = rows[0]["yaw_rad_s"] * 57.29577951308232
    _quiet(cases, "baseline [mm]", "largest speed [m/s]", f"every direction at δt = 2 ms; yaw {yaw:.0f} °/s")
    _legend(cases, "", loc="upper right")
    return figure
