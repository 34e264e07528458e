"""The split into near and far finds the gaps that GapFlyt flew through, in their own frames."""

import struct

import numpy as np
import pytest

from morpheyes_daemon.benchmarks.gap_on_real_images import focus_of_expansion, gap_images, largest_hole, read_flo
from morpheyes_daemon.errors import InputError
from tests.support.real_images import real_images


@pytest.mark.realdata
def test_contours_of_real_gaps_match_the_masks_drawn_by_hand():
    found = {(row.scene, row.flow): row.iou for row in gap_images(real_images("gapflyt").parent)}
    # measured 0.93, 0.88, 0.83, 0.78, 0.76; thresholding the authors' flow gives 0.84 (data/gapflyt/SOURCE.md)
    assert found["A, large step", "flownet2"] > 0.88
    assert found["A, small step", "flownet2"] > 0.83
    assert found["A, small step", "dis"] > 0.75
    assert found["B", "dis"] > 0.70
    assert found["B", "flownet2"] > 0.70


def test_flow_files_are_read_and_bad_ones_refused(tmp_path):
    flow = np.arange(24, dtype=np.float32).reshape(3, 4, 2)
    good, cut, other = (tmp_path / name for name in ("good.flo", "cut.flo", "other.flo"))
    data = struct.pack("<fii", 202021.25, 4, 3) + flow.tobytes()
    good.write_bytes(data)
    cut.write_bytes(data[:-4])
    other.write_bytes(b"no flow at all")
    assert (read_flo(good) == flow).all()
    for bad in (cut, other, tmp_path / "missing.flo"):
        with pytest.raises(InputError):
            read_flo(bad)


def test_missing_images_are_a_sentence(tmp_path):
    with pytest.raises(InputError, match="MORPHEYES_DATA"):
        gap_images(tmp_path)


def test_flow_of_forward_motion_points_away_from_where_one_flies():
    row, column = np.mgrid[0:120, 0:160].astype(np.float32)
    flow = np.stack([0.05 * (column - 90), 0.05 * (row - 40)], axis=-1)
    assert focus_of_expansion(flow) == pytest.approx((90, 40), abs=0.5)


def test_a_hole_is_found_in_flow_lengths():
    inverse = np.full((120, 160), 20.0, np.float32) + np.random.default_rng(0).normal(0, 0.3, (120, 160)).astype(
        np.float32
    )
    inverse[40:80, 60:110] = 8.0
    hole, separation, bimodal = largest_hole(inverse)
    assert bimodal
    assert separation > 5
    assert hole[40:80, 60:110].mean() > 0.9
    assert hole.sum() < 1.1 * 40 * 50
