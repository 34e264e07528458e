"""The missions' part of docs/results.md, made from campaign folders: what the paper says, what came out, why.

Nothing here flies; it reads what `morpheyes experiment` left behind. The rest of the page is kept as it is.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from morpheyes_daemon.campaigns.forest_table import Row
from morpheyes_daemon.campaigns.results import SETTINGS, TABLE
from morpheyes_daemon.config.vehicle import StereoConfig
from morpheyes_daemon.errors import InputError
from morpheyes_daemon.flights.flight_plan import DISPARITIES_OF_PX, usual_calibration
from morpheyes_daemon.flights.sim_vehicle import WIND_M_S

BEGIN = "<!-- missions: written by `morpheyes results` -->"
END = "<!-- end of missions -->"

TITLES = {"forest": "Forest", "gap": "Gap", "imo": "Moving object"}

PAPER = {
    "forest": (
        "The paper flew a forest once per baseline, at 1 Hz: the large fixed baseline crashed, the small one was four "
        "times slower, the variable one came through. Peers fly up to 3 m/s at over 400 trees per hectare with VI-SLAM "
        "and maps."
    ),
    "gap": (
        "The paper shows one crossing of each shape and of a moving gap. Peers report 85 % at 2.5 m/s with 50 mm to "
        "spare, and 3 m/s with 40 mm."
    ),
    "imo": "The paper shows one trajectory; each fixed baseline loses the object somewhere along its range.",
}
"""What there is to compare with."""

WHY = {
    "forest": (
        "Differences: our fixed baselines run under the same speed governor as the variable one, so a baseline that "
        "sees badly makes the vehicle slow or stop, not crash; the paper held the speed and counted crashes."
    ),
    "gap": (
        "Every opening is just large enough for the silhouette at a lean of 12° and 40 mm on every side; `small` ones "
        "are to be refused. Success counts a crossing in which neither hull, bar nor propellers touch. Differences: "
        "the paper shows crossings, we count them. A wall that sways is led by its wave, and where it turns back its "
        "speed is small; one that moves irregularly has no such moment, and what it does in the second and a half of "
        "the run nobody knows, which at 0.5 m/s is many times 40 mm. Without the eyes' mount measured, where they look "
        "on the body is off by half a degree, which a swaying wall hides from the filter that takes it out before a "
        "standing one."
    ),
    "imo": (
        "A detection counts only where this frame's own measurement lies within max(0.3 m, 5 %) of the visible face; "
        "predictions of the filter do not. Differences: like the paper's, held eyes lose the object at one end, 0.3 m "
        "apart they do not see it near (a disparity of 160 pixels is 1.4 m then), 0.1 m apart they lose it far away, "
        "where a disparity of half a pixel is a metre. The first frames of every flight are lost by all: an object that "
        "begins to move is believed after two frames, and at a few centimetres per second half a metre before the "
        "eyes after two more, since the vehicle's own motion is not known better."
    ),
}


def write_page(folders: Sequence[Path], page: Path) -> str:
    """Replace the missions' part of `page` by what the campaigns in `folders` found; return that part.

    Raises InputError naming a folder that holds no finished campaign.
    """
    part = missions_part([_read(folder) for folder in folders])
    text = page.read_text(encoding="utf-8") if page.is_file() else "# Results\n"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(_with_part(text, part), encoding="utf-8")
    return part


def missions_part(found: Sequence[tuple[Row, str]]) -> str:
    """Return Markdown for (settings, table) of every campaign, mission by mission in the order given."""
    blocks = []
    for strategy in dict.fromkeys(settings["strategy"] for settings, _ in found):
        blocks.append(f"## {TITLES.get(strategy, strategy)}")
        if strategy in PAPER:
            blocks.append(PAPER[strategy])
        for settings, table in found:
            if settings["strategy"] == strategy:
                blocks += [f"{_conditions(settings)}\n`{_command(settings)}`", table.strip()]
        if strategy in WHY:
            blocks.append(WHY[strategy])
    return "\n\n".join(blocks)


def _conditions(settings: Row) -> str:
    return (
        f"World `{settings['world']}`, {settings['image_size']}, {settings['rate_hz']:g} Hz with "
        f"{settings['latency_ms']:g} ms of latency, {_disparities(settings['disparities_fraction'])} disparities at "
        f"{DISPARITIES_OF_PX} px, wind {settings['wind_m_s']:g} m/s{_calibrated(settings)}:"
    )


def _calibrated(settings: Row) -> str:
    how = {"solved": "", "mounted": ", the eyes' mount measured as well", "exact": ", exact calibration"}
    return how[settings.get("calibration", "solved")]


def _command(settings: Row) -> str:
    low, high = settings["seeds"]
    options = [f"--seeds {low}-{high}", f"--size {settings['image_size']}"]
    if settings["baselines"] != ["variable"]:
        options.append(f"--baselines {','.join(settings['baselines'])}")
    usual: dict[str, Any] = {"rate_hz": 5.0, "latency_ms": StereoConfig().latency_ms, "wind_m_s": WIND_M_S}
    options += [f"--{key.replace('_', '-')} {settings[key]:g}" for key, value in usual.items() if settings[key] != value]
    if settings["disparities_fraction"] != StereoConfig().disparities_fraction:
        options.append(f"--disparities {_disparities(settings['disparities_fraction'])}")
    calibration = settings.get("calibration", "solved")
    if calibration != usual_calibration(settings["strategy"]):
        options.append(f"--calibration {calibration}")
    return " ".join([f"morpheyes experiment {settings['mission']}", *options, f"--world {settings['world']}"])


def _disparities(fraction: float) -> int:
    return round(fraction * DISPARITIES_OF_PX)


def _read(folder: Path) -> tuple[Row, str]:
    try:
        settings = json.loads((folder / SETTINGS).read_text(encoding="utf-8"))
        return settings, (folder / TABLE).read_text(encoding="utf-8")
    except FileNotFoundError as error:
        name = Path(str(error.filename)).name
        raise InputError(f"{folder}: has no {name}; is it the --out of a finished `morpheyes experiment`?") from None
    except (OSError, json.JSONDecodeError) as error:
        raise InputError(f"{folder}: cannot be read ({error}).") from None


def _with_part(text: str, part: str) -> str:
    block = f"{BEGIN}\n\n{part}\n\n{END}"
    if BEGIN in text and END in text:
        before, _, rest = text.partition(BEGIN)
        return before + block + rest.partition(END)[2]
    return f"{text.rstrip()}\n\n{block}\n"
