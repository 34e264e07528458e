"""Real chessboards: the solve is as good as the pictures, the bad picture is named, the known baseline comes out."""

import pytest

from morpheyes_daemon.calibration.solver.pipeline import solve_folder
from morpheyes_daemon.calibration.targets.boards import parse_board
from tests.support.real_images import real_images

pytestmark = pytest.mark.realdata


def test_opencvs_own_chessboards() -> None:
    solved = solve_folder(real_images("chess_opencv"), parse_board("9x6", 0.025), None)
    assert solved.calibration.rms_px[0] <= 0.22, "thirteen pairs, squares of unknown size taken as 25 mm"
    assert solved.calibration.lengths_m[0] / 0.025 == pytest.approx(3.33, abs=0.01), "squares, as its notes say"
    assert not solved.calibration.outliers


def test_stereopi_chessboards_and_their_outlier() -> None:
    solved = solve_folder(real_images("chess_stereopi"), parse_board("9x6", 0.025), None)
    figures = solved.figures()
    assert figures["outliers"] == ["right_15.png"]
    assert figures["rms_px"][0] <= 0.20, "all twenty pairs solved naively give 0.51"
    assert figures["baselines_mm"][0] == pytest.approx(57.7, abs=0.2)
    assert solved.held_out.median_px < 0.05
