"""Path-traced pictures and the fast renderer's agree in depth; skipped without Mitsuba, which is an extra."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.paper.path_traced_stills import StillPlan, make_stills

pytest.importorskip("numba")


@pytest.mark.skipif(find_spec("mitsuba") is None, reason="Mitsuba is not installed (the figures extra)")
@pytest.mark.slow
@pytest.mark.parametrize(("world", "first_m", "valid"), [("gap", 1.0, 0.8), ("room", -1.5, 0.5)])
def test_depth_agrees_out_of_doors_and_in_a_room_with_lamps(
    world: str, first_m: float, valid: float, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    plan = StillPlan(world, first_m=first_m, size=(320, 240), samples=16)
    (result,) = make_stills(plan, tmp_path, lambda what, done, total: None)
    assert capfd.readouterr().out == ""  # which belongs to --json
    assert min(result.fast_valid, result.traced_valid) > valid
    assert result.difference_px < 0.3
    assert result.traced_error_px < 0.3
    assert (tmp_path / "000_compared.png").stat().st_size > 0


def test_eyes_stand_a_baseline_apart_and_look_where_they_are_told() -> None:
    plan = StillPlan("gap", first_m=2.0, step_m=0.5, yaw_deg=90.0, baseline_m=0.3)
    left, right = (plan.T_ned_cam(2, eye) for eye in (0, 1))
    assert np.allclose(left[:3, 3], [3.0, 0.0, -1.5])
    assert np.allclose(left[:3, 2], [0.0, 1.0, 0.0], atol=1e-12)
    # looking east, the right eye stands to the south
    assert np.allclose(right[:3, 3] - left[:3, 3], [-0.3, 0.0, 0.0])
