"""Map, strips and film show the flight, to scale and in the right colours."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest

from morpheyes_daemon.bus import EventLog, Topics
from morpheyes_daemon.clock import S
from morpheyes_daemon.config.vehicle import Footprint
from morpheyes_daemon.messages.core import BaselineEstimate, VehicleState
from morpheyes_daemon.messages.reasons import Reason
from morpheyes_daemon.messages.safety import Action, GateOutput, State
from morpheyes_daemon.recorder.pictures.film import FlightFilm
from morpheyes_daemon.recorder.pictures.map import DPI, LEFT_IN, RIGHT_IN, WIDTH_IN, draw_map
from morpheyes_daemon.recorder.pictures.outline import Track, clearances, closest_passes
from morpheyes_daemon.recorder.pictures.scene import Disc, ObstacleMap
from morpheyes_daemon.recorder.pictures.strips import draw_strips
from morpheyes_daemon.recorder.pictures.topview import TREE, Pose, TopView
from morpheyes_daemon.recorder.reader import read_flight
from morpheyes_daemon.recorder.recorder import Recorder
from morpheyes_daemon.recorder.series import FlightSeries
from morpheyes_daemon.stereo.colours import UNKNOWN_BGR, baseline_bgr, colour_depth
from tests.support.hand_clock import HandClock
from tests.support.synthetic_flight import SyntheticFlight, forest_scene


def straight_flight(baseline_m: float, length_m: float = 40.0) -> FlightSeries:
    """North along the x axis at 2 m/s with one baseline."""
    series = FlightSeries()
    for i in range(round(length_m * 5) + 1):
        t = S + i * S // 10
        series.add("vehicle", VehicleState(t_ns=t, position_t_ns=t, p_ned_m=(0.2 * i, 0.0, -1.5)))
        series.add("baseline", BaselineEstimate(t, baseline_m, baseline_m, 0.001, False))
    return series


def forest_flight(seconds: float = 20.0) -> FlightSeries:
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    series = FlightSeries()
    series.watch(topics, events)
    SyntheticFlight(topics, events, clock, images=False).fly(seconds)
    return series


def share_of(picture: Any, bgr: tuple[int, int, int], tolerance: int = 6) -> float:
    return float((np.abs(picture.astype(int) - np.array(bgr)).max(axis=2) <= tolerance).mean())


@pytest.mark.parametrize(("baseline_m", "other_m"), [(0.1, 0.3), (0.3, 0.1), (0.2, 0.1)])
def test_path_has_the_colour_of_its_baseline(tmp_path: Path, baseline_m: float, other_m: float) -> None:
    draw_map(tmp_path / "map.png", straight_flight(baseline_m), ObstacleMap(), Footprint())
    picture = cv2.imread(str(tmp_path / "map.png"))
    above_the_colour_bar = picture[: picture.shape[0] * 6 // 10]
    assert share_of(above_the_colour_bar, baseline_bgr(baseline_m)) > 1e-3
    assert share_of(above_the_colour_bar, baseline_bgr(other_m)) == 0.0


def test_trunks_are_drawn_to_scale(tmp_path: Path) -> None:
    """Filled area against pi r^2; 8 % for the drawn edge, which is another colour, and anti-aliasing."""
    series, disc = straight_flight(0.2), Disc(20.0, 3.0, 1.5)
    draw_map(tmp_path / "with.png", series, ObstacleMap((disc,)), Footprint())
    picture = cv2.imread(str(tmp_path / "with.png"))
    map_part = picture[: round(0.6 * picture.shape[0])]
    pixels = share_of(map_part, (0x5F, 0x78, 0x66)) * map_part.shape[0] * map_part.shape[1]
    px_per_m = DPI * (WIDTH_IN - LEFT_IN - RIGHT_IN) / (40.0 + 2 * 2.5)
    assert pixels == pytest.approx(np.pi * (1.5 * px_per_m) ** 2, rel=0.08)


def test_map_of_nothing_is_still_a_picture(tmp_path: Path) -> None:
    draw_map(tmp_path / "empty.png", FlightSeries(), ObstacleMap(), Footprint())
    draw_map(tmp_path / "scene.png", FlightSeries(), forest_scene(), Footprint(), collided=True)
    assert cv2.imread(str(tmp_path / "scene.png")) is not None


def test_walls_and_close_ups_are_drawn(tmp_path: Path) -> None:
    wall = (((8.0, -3.0), (8.3, -3.0), (8.3, -0.6), (8.0, -0.6)),)
    draw_map(tmp_path / "a.png", straight_flight(0.2), ObstacleMap((Disc(20.0, 0.7, 0.3),), wall), Footprint())
    draw_map(tmp_path / "b.png", straight_flight(0.2), ObstacleMap(polygons=wall), Footprint())
    a, b = cv2.imread(str(tmp_path / "a.png")), cv2.imread(str(tmp_path / "b.png"))
    assert a.shape[0] > b.shape[0]  # the row of close-ups
    assert share_of(b, (139, 154, 167)) > 1e-4


def test_clearance_is_from_the_outline_to_the_trunk() -> None:
    track = Track.of(straight_flight(0.3))
    footprint = Footprint()
    beside = ObstacleMap((Disc(20.0, 1.0, 0.2),))
    assert clearances(track, beside, footprint).min() == pytest.approx(1.0 - 0.2 - 0.337 / 2, abs=1e-9)
    ahead = ObstacleMap((Disc(45.0, 0.0, 0.2),))
    assert clearances(track, ahead, footprint).min() == pytest.approx(5.0 - 0.2 - 0.337 / 2, abs=1e-9)
    wide = Footprint(hull_width_mm=200.0)
    beside_the_bar = ObstacleMap((Disc(20.09, 1.0, 0.2),))
    assert clearances(track, beside_the_bar, wide).min() == pytest.approx(1.0 - 0.2 - 0.33 / 2, abs=1e-9)


def test_closest_passes_are_near_and_apart() -> None:
    track = Track.of(straight_flight(0.2))
    scene = ObstacleMap((Disc(5.0, 0.6, 0.1), Disc(5.4, 0.7, 0.1), Disc(20.0, 0.8, 0.1), Disc(30.0, 3.0, 0.1)))
    passes = closest_passes(track, clearances(track, scene, Footprint()), 9)
    assert [round(float(track.xy_m[i, 0])) for i in passes] == [5, 20]


def test_brakings_and_stops_are_told_apart_and_the_end_is_neither() -> None:
    series = forest_flight()
    t = series.start_ns + 30 * S
    series.add("gate", GateOutput(t, State.BRAKING, Action.NEUTRAL, Reason.GOAL_REACHED))
    for found in (series.braking(), series.stops()):
        assert [reason for _, reason in found] == ["no_free_path"]
        assert found[0][0] == pytest.approx(14.2, abs=0.2)  # five decisions a second


def test_strips_are_drawn_whole_and_of_nothing(tmp_path: Path) -> None:
    draw_strips(tmp_path / "strips.png", forest_flight())
    draw_strips(tmp_path / "empty.png", FlightSeries())
    full, empty = cv2.imread(str(tmp_path / "strips.png")), cv2.imread(str(tmp_path / "empty.png"))
    engaged, braking = (0xC4, 0xE3, 0xBF), (0xA6, 0xB8, 0xF6)
    assert share_of(full, engaged) > 0.01
    assert share_of(full, braking) > 0.001
    assert share_of(empty, engaged) == 0.0


def test_depth_colours_run_from_far_to_near_and_leave_unknown_dark() -> None:
    depth = np.array([[0.1, 0.5, 2.0, 8.0, 30.0, 99.0, np.nan, 0.0]], dtype=np.float32)
    picture = colour_depth(depth)[0]
    assert picture.shape == (8, 3)
    assert (picture[0] == picture[1]).all()
    assert (picture[4] == picture[5]).all()
    assert (picture[6] == UNKNOWN_BGR).all()
    assert (picture[7] == UNKNOWN_BGR).all()
    assert len({tuple(int(c) for c in pixel) for pixel in picture}) == 5
    assert picture[1, 2] > picture[1, 0]  # near is red
    assert picture[4, 0] > picture[4, 2]  # far is blue


def test_view_from_above_has_north_up_and_east_right() -> None:
    pose = Pose(10.0, 5.0, 0.3, 1.0, 0.0, 0.2, 4.0, 0.8)
    for disc, inside in (
        (Disc(14.0, 5.0, 0.5), (slice(0, 180), slice(200, 280))),
        (Disc(10.0, 9.0, 0.5), (slice(200, 330), slice(350, 450))),
    ):
        picture = TopView(ObstacleMap((disc,)), Footprint()).draw(pose)
        green = np.abs(picture.astype(int) - np.array(TREE)).max(axis=2) <= 6
        assert green[inside].sum() > 0.9 * green.sum() > 0


def test_film_is_h264_for_browsers_and_runs_in_the_flight_s_own_time(tmp_path: Path) -> None:
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    film = FlightFilm(tmp_path / "flight.mp4", forest_scene(), Footprint())
    film.watch(topics)
    SyntheticFlight(topics, events, clock).fly(4.0)
    film.close()
    with av.open(str(tmp_path / "flight.mp4")) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        times = [float(frame.time) for frame in container.decode(stream)]
    assert times == pytest.approx([0.2 * i for i in range(20)], abs=1e-3)
    head = (tmp_path / "flight.mp4").read_bytes()
    assert head.index(b"moov") < head.index(b"mdat")  # plays before it is loaded whole


def test_film_can_be_made_from_a_log(tmp_path: Path) -> None:
    topics, events, clock = Topics.create(), EventLog(), HandClock()
    recorder = Recorder(topics, events, clock, tmp_path / "a.mcap", {}, image_rate_hz=5.0, threaded=False)
    SyntheticFlight(topics, events, clock).fly(3.0)
    recorder.close()
    frames = FlightFilm.of_log(tmp_path / "log.mp4", read_flight(tmp_path / "a.mcap"), forest_scene(), Footprint())
    assert frames == 15
    with av.open(str(tmp_path / "log.mp4")) as container:
        assert sum(1 for _ in container.decode(video=0)) == 15


def test_film_without_a_single_image_is_closed_without_error(tmp_path: Path) -> None:
    FlightFilm(tmp_path / "none.mp4", ObstacleMap(), Footprint()).close()


FULL_DISK = """
import resource, signal, sys
import subprocess
import sys
from pathlib import Path
import numpy as np
from morpheyes_daemon.errors import RecordingError
from morpheyes_daemon.recorder.pictures.video import VideoWriter
video = VideoWriter(Path(sys.argv[1]))
for i in range(60):
    video.add(0.2 * i, np.random.default_rng(i).integers(0, 255, (240, 320, 3), np.uint8))
for _ in range(2):
    try:
        video.close()
    except RecordingError as error:
        print(error)
"""


def test_a_film_on_a_full_disk_is_one_sentence() -> None:
    """Guards `sim --out` on a full disk: FFmpeg's file output ended the process with SIGSEGV."""
    done = subprocess.run([sys.executable, "-c", FULL_DISK, "/dev/full"], capture_output=True, text=True)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "/dev/full: the film cannot be written there (No space left on device).\n"
