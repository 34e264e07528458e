"""Report of a calibration: acceptance, figures of its quality, and pictures to take again.

One self-contained HTML file, or a PNG of the figures alone; nothing is loaded from the network. All content comes from
the calibration file, so a report can be made at any time.
"""

from __future__ import annotations

import html
import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from morpheyes_daemon.calibration.report import figures
from morpheyes_daemon.calibration.report.depth_error_budget import Conditions
from morpheyes_daemon.errors import CalibrationError
from morpheyes_daemon.stereo.calibration_file import calibration_hash
from morpheyes_daemon.stereo.rig import RigModel

_GREEN, _AMBER, _RED = "#1f7a54", "#b26a00", "#b3261e"
_SVG: dict[Any, Any] = {"font.family": "sans-serif", "svg.fonttype": "none", "svg.hashsalt": "morpheyes"}

_STYLE = """
:root { --ink: #1c2430; --muted: #66707f; --line: #e3e7ec; --paper: #ffffff; --ground: #f5f6f8; }
* { box-sizing: border-box; }
body { margin: 0; background: var(--ground); color: var(--ink);
       font: 15px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
main { max-width: 1040px; margin: 0 auto; padding: 28px 20px 60px; }
header h1 { font-size: 22px; margin: 0 0 2px; } header p { margin: 0; color: var(--muted); }
.verdict { color: #fff; border-radius: 12px; padding: 18px 22px; margin: 18px 0; }
.verdict b { display: block; font-size: 24px; line-height: 1.25; }
.verdict ul { margin: 8px 0 0; padding-left: 20px; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(150px, 1fr)); gap: 12px; margin-bottom: 18px; }
.card { background: var(--paper); border: 1px solid var(--line); border-radius: 12px; padding: 12px 14px; }
.card span { color: var(--muted); font-size: 12.5px; display: block; }
.card b { font-size: 21px; font-variant-numeric: tabular-nums; }
section { background: var(--paper); border: 1px solid var(--line); border-radius: 12px; padding: 18px 20px 14px;
          margin-bottom: 18px; }
h2 { font-size: 16px; margin: 0 0 4px; } section > p { color: var(--muted); margin: 0 0 10px; max-width: 75ch; }
svg { width: 100%; height: auto; display: block; }
.two { display: grid; grid-template-columns: 1fr 1fr; gap: 20px; align-items: start; }
@media (max-width: 760px) { .two { grid-template-columns: 1fr; } }
.scroll { overflow-x: auto; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; font-size: 13.5px; width: 100%; }
th { text-align: right; color: var(--muted); font-weight: 500; } td { text-align: right; }
th, td { padding: 4px 10px; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
footer { color: var(--muted); font-size: 12.5px; overflow-wrap: anywhere; }
"""


def write_report(rig: RigModel, out: Path, conditions: Conditions | None = None) -> None:
    """Write the report of `rig` as HTML or PNG by the suffix of `out`; raises CalibrationError for any other suffix,
    and when the file cannot be written."""
    expected = conditions or Conditions()
    if out.suffix.lower() not in (".html", ".htm", ".png"):
        raise CalibrationError(f"{out}: a report is written as .html or .png; name it so.")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.suffix.lower() == ".png":
            out.write_bytes(report_png(rig, expected))
        else:
            out.write_text(report_html(rig, expected), encoding="utf-8")
    except OSError as error:
        raise CalibrationError(f"{out}: the report cannot be written there ({error.strerror}).") from None


def report_html(rig: RigModel, conditions: Conditions) -> str:
    """Return the report as one HTML page."""
    title = f"Calibration of {rig.details.get('rig', 'a stereo rig')}"
    sections = [
        _section("Depth error to expect", _depth_text(conditions), figures.depth_error_bars(rig, conditions)),
        _section("Fit at each baseline", _FIT, figures.rms_bars(rig)),
        _beside(
            _block("Rows on held-out boards", _HELD_OUT, figures.held_out_map(rig)),
            _block("Scale check", "", None, _scale(rig)),
        ),
        _section("Leaving one baseline out", _LEFT_OUT, figures.leave_one_out_curve(rig)),
        _section("Along the rail", _RAIL, figures.rail_curves(rig)),
        _section("Where boards were seen", _COVERAGE, figures.coverage_map(rig)),
        _section("Baselines", "", None, _baseline_table(rig)),
        _section("Cameras", "", None, _camera_table(rig)),
        _section("Pictures set aside", "", None, _set_aside(rig)),
    ]
    return (
        f"<!doctype html><html lang=en><meta charset=utf-8><meta name=viewport content='width=device-width'>"
        f"<title>{html.escape(title)}</title><style>{_STYLE}</style><main>"
        f"<header><h1>{html.escape(title)}</h1><p>{html.escape(_subtitle(rig))}</p></header>"
        f"{_acceptance(rig)}{_cards(rig)}{''.join(sections)}"
        f"<footer>sha256 {calibration_hash(rig)}</footer></main></html>"
    )


def report_png(rig: RigModel, conditions: Conditions) -> bytes:
    """Return the figures, stacked, as the content of a PNG file."""
    import cv2

    drawn = [
        figures.depth_error_bars(rig, conditions),
        figures.rms_bars(rig),
        figures.held_out_map(rig),
        figures.leave_one_out_curve(rig),
        figures.rail_curves(rig),
        figures.coverage_map(rig),
    ]
    strips = [_pixels(figure) for figure in drawn if figure is not None]
    width = max(strip.shape[1] for strip in strips)
    page = [np.pad(s, ((20, 20), (0, width - s.shape[1]), (0, 0)), constant_values=255) for s in strips]
    title = Figure(figsize=(9.6, 0.7))
    title.text(0.01, 0.62, f"Calibration of {rig.details.get('rig', 'a stereo rig')}", size=14, color=figures.INK)
    title.text(0.01, 0.15, str(rig.details.get("verdict", rig.method)), size=10, color=_colour(rig))
    page.insert(0, np.pad(_pixels(title), ((10, 0), (0, 0), (0, 0)), constant_values=255)[:, :width])
    encoded = cv2.imencode(".png", np.vstack(page))[1]
    return bytes(encoded)


_FIT = "Distance between detected and predicted corners, and row offsets on held-out boards."
_HELD_OUT = "After rectification a corner should lie on the same row in both images. Boards were left out in turn."
_LEFT_OUT = "Each inner baseline is left out and predicted by the others: the accuracy between calibrated baselines."
_RAIL = "Pose of the right camera relative to the left one. Dots were calibrated; lines are interpolated as in flight."
_COVERAGE = "Corners per cell of the image. The lens model is only determined where boards were seen."


def _depth_text(conditions: Conditions) -> str:
    return (
        f"One sigma, for a matcher noise of {conditions.sigma_disparity_px:g} px, a servo repeatability of "
        f"{conditions.sigma_servo_m * 1e3:g} mm, a time offset of {conditions.sync_s * 1e3:g} ms and "
        f"{conditions.sideways_m_s:g} m/s sideways. Colours are shares of the variance; percent of the distance."
    )


def _subtitle(rig: RigModel) -> str:
    details = rig.details
    board = details.get("board", {})
    low, high = (length * 1e3 for length in rig.range_m)
    parts = [
        str(details["date"]) if "date" in details else "",
        f"{rig.size[0]}x{rig.size[1]} px",
        f"baseline {low:g} mm" if low == high else f"baselines {low:g} to {high:g} mm",
        f"board {board['board']}, {board['square_mm']:g} mm squares" if "square_mm" in board else "",
        "known exactly, not solved" if rig.method == "exact" else "",
    ]
    return " · ".join(part for part in parts if part)


def _colour(rig: RigModel) -> str:
    text = str(rig.details.get("verdict", ""))
    return _GREEN if text.startswith("fit") else _RED if text.startswith("do not") else _AMBER


def _acceptance(rig: RigModel) -> str:
    text = str(rig.details.get("verdict", "not judged: this file has no figures of a solve"))
    head, _, reason = text.partition(": ")
    advice = [item for item in rig.details.get("retake", []) if item != reason]
    items = "".join(f"<li>{html.escape(item)}</li>" for item in ([reason] if reason else []) + advice)
    head = head[:1].upper() + head[1:]
    return f"<div class=verdict style='background:{_colour(rig)}'><b>{html.escape(head)}</b><ul>{items}</ul></div>"


def _cards(rig: RigModel) -> str:
    details = rig.details
    chosen = figures.calibrated(rig)
    held = details.get("held_out", {})
    left_out = [row["epipolar_median_px"] for row in details.get("leave_one_out", [])]
    yaw = [np.degrees(b.sigma_yaw_rad) for b in chosen if b.sigma_yaw_rad is not None]
    length = [b.sigma_length_m * 1e3 for b in chosen if b.sigma_length_m is not None]
    cards = [
        ("held-out rows, median", f"{held['median_px']:.3f} px" if held else None),
        ("held-out rows, 95 %", f"{held['p95_px']:.3f} px" if held else None),
        ("a baseline left out, worst", f"{max(left_out):.3f} px" if left_out else None),
        ("yaw, one sigma at worst", f"{max(yaw):.4f}°" if yaw else None),
        ("length, one sigma at worst", f"{max(length):.2f} mm" if length else None),
        ("baselines", str(len(chosen))),
        ("views", str(sum(details["views"])) if "views" in details else None),
    ]
    shown = [f"<div class=card><span>{name}</span><b>{value}</b></div>" for name, value in cards if value]
    return f"<div class=cards>{''.join(shown)}</div>"


def _scale(rig: RigModel) -> str:
    scale = rig.details.get("scale")
    if not scale:
        return ""
    board = rig.details["board"]["square_mm"]
    rows = [
        ("squares as given", f"{board:.3f} mm"),
        ("squares triangulated from both cameras", f"{scale['square_mm']:.3f} ± {scale['square_scatter_mm']:.3f} mm"),
    ]
    if scale.get("length_ratio") is not None:
        rows.append(("solved lengths against the folders' names", f"× {scale['length_ratio']:.4f}"))
    note = (
        "No picture shows the size of a square: if it was given wrongly, all depths are wrong by the same factor. "
        "Measure a distance in view with a tape and compare."
    )
    return _table((), rows) + f"<p style='color:var(--muted)'>{note}</p>"


def _baseline_table(rig: RigModel) -> str:
    rows = []
    for baseline in figures.calibrated(rig):
        length = float(np.linalg.norm(baseline.t_cam0_cam1_m)) * 1e3
        rows.append(
            (
                f"{baseline.nominal_m * 1e3:g} mm",
                f"{length:.3f} mm",
                _shown(baseline.sigma_length_m, 1e3, "± {:.3f} mm"),
                _shown(baseline.sigma_yaw_rad, 180 / np.pi, "± {:.4f}°"),
                _shown(baseline.rms_px, 1.0, "{:.3f} px"),
            )
        )
    return _table(("nominal", "length", "length, σ", "yaw, σ", "rms"), rows)


def _camera_table(rig: RigModel) -> str:
    sigma = rig.details.get("sigma", {})
    rows = []
    for name, attribute in (("fx_px", "fx"), ("fy_px", "fy"), ("cx_px", "cx"), ("cy_px", "cy"), ("alpha", "alpha")):
        values = [getattr(camera, attribute) for camera in (rig.cam0, rig.cam1)]
        rows.append((name, *_with_sigma(name, values, sigma)))
    for index in range(5):
        name = f"k{index + 1}"
        rows.append((name, *_with_sigma(name, [rig.cam0.k[index], rig.cam1.k[index]], sigma)))
    return _table(("", "left", "σ", "right", "σ"), rows)


def _with_sigma(name: str, values: list[float], sigma: Any) -> tuple[str, str, str, str]:
    shown = []
    for value, side in zip(values, ("cam0", "cam1"), strict=True):
        known = sigma.get(side, {}).get(name)
        shown += [f"{value:.5g}" if abs(value) < 10 else f"{value:.3f}", "" if known is None else f"± {known:.2g}"]
    return shown[0], shown[1], shown[2], shown[3]


def _set_aside(rig: RigModel) -> str:
    outliers = rig.details.get("outliers", [])
    problems = rig.details.get("problems", [])
    rows = [(str(outlier["file"]), f"does not fit: {outlier['rms_px']:.2f} px") for outlier in outliers]
    items = "".join(f"<li>{html.escape(str(problem))}</li>" for problem in problems)
    listed = (_table((), rows) if rows else "") + (f"<ul>{items}</ul>" if items else "")
    return listed or ("<p>None.</p>" if "outliers" in rig.details else "")


def _table(header: tuple[str, ...], rows: Sequence[tuple[str, ...]]) -> str:
    head = "<tr>" + "".join(f"<th>{html.escape(cell)}</th>" for cell in header) + "</tr>" if header else ""
    body = "".join("<tr>" + "".join(f"<td>{html.escape(cell)}</td>" for cell in row) + "</tr>" for row in rows)
    return f"<div class=scroll><table>{head}{body}</table></div>"


def _section(title: str, text: str, figure: Figure | None, content: str = "") -> str:
    block = _block(title, text, figure, content)
    return f"<section>{block}</section>" if block else ""


def _beside(left: str, right: str) -> str:
    shown = [block for block in (left, right) if block]
    return f"<section><div class=two>{''.join(f'<div>{b}</div>' for b in shown)}</div></section>" if shown else ""


def _block(title: str, text: str, figure: Figure | None, content: str = "") -> str:
    if figure is None and not content:
        return ""
    drawn = "" if figure is None else _svg(figure)
    return f"<h2>{title}</h2>" + (f"<p>{html.escape(text)}</p>" if text else "") + drawn + content


def _svg(figure: Figure) -> str:
    import matplotlib as mpl

    stream = io.StringIO()
    with mpl.rc_context(_SVG):
        figure.savefig(stream, format="svg", metadata={"Date": None}, facecolor="none")
    text = stream.getvalue()
    return text[text.index("<svg") :]


def _pixels(figure: Figure) -> np.ndarray[Any, np.dtype[np.uint8]]:
    import cv2

    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=120, facecolor="white")
    drawn = cv2.imdecode(np.frombuffer(stream.getvalue(), dtype=np.uint8), cv2.IMREAD_COLOR)
    return np.asarray(drawn, dtype=np.uint8)


def _shown(value: float | None, factor: float, text: str) -> str:
    return "" if value is None else text.format(value * factor)
