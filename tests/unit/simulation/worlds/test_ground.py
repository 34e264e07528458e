"""Ground that slopes and rolls: the vehicle stands on it, the rangefinder sees it, Loiter keeps over it."""

from __future__ import annotations

import math

import numpy as np
import pytest

from morpheyes_daemon.simulation.airframe.dynamics import STEP_S, Airframe, Vehicle
from morpheyes_daemon.simulation.autopilot.ekf import NOISELESS, Estimator
from morpheyes_daemon.simulation.autopilot.flight_modes import FlightSettings, Mode
from morpheyes_daemon.simulation.autopilot.mode_controllers import FlightControl
from morpheyes_daemon.simulation.autopilot.parameters import ParameterTable
from morpheyes_daemon.simulation.autopilot.rc_input import PilotInput
from morpheyes_daemon.simulation.worlds.ground import LEVEL, Ground, GroundShape, lay

UPHILL = lay(GroundShape(slope_deg=10.0), seed=0)


def test_ground_starts_at_zero_and_rises_by_its_slope() -> None:
    assert UPHILL.height_m(0.0, 7.0) == 0.0
    assert UPHILL.height_m(10.0, 0.0) == pytest.approx(10.0 * math.tan(math.radians(10.0)))
    assert LEVEL.height_m(3.0, 4.0) == 0.0


def test_waves_stay_within_their_height_and_differ_by_seed() -> None:
    one, other = (lay(GroundShape(rolling_m=0.8), seed) for seed in (1, 2))
    heights = [one.height_m(x, y) for x in range(0, 100, 3) for y in range(-40, 40, 3)]
    assert one.height_m(0.0, 0.0) == 0.0
    # measured from the start, which may lie at the bottom or on the top of a wave
    assert 0.8 < max(heights) - min(heights) <= 1.6
    assert one.height_m(20.0, 5.0) != other.height_m(20.0, 5.0)


@pytest.mark.parametrize("lean_deg", [-15.0, 0.0, 12.0])
def test_a_tilted_beam_meets_the_slope_where_geometry_says(lean_deg: float) -> None:
    lean, rise = math.radians(lean_deg), math.tan(math.radians(10.0))
    found = UPHILL.range_m((0.0, 0.0, -1.5), (math.sin(lean), 0.0, math.cos(lean)))
    # 1.5 m less what the beam goes down is what the ground has come up by then
    assert found == pytest.approx(1.5 / (math.cos(lean) + rise * math.sin(lean)), abs=1e-3)


def test_a_bush_below_is_nearer_than_the_ground() -> None:
    ground = Ground(bushes=np.array([[5.0, 0.0, -0.5, 0.4, 0.4, 0.5]]))
    straight_down = (0.0, 0.0, 1.0)
    assert ground.range_m((5.0, 0.0, -1.5), straight_down) == pytest.approx(0.5)
    assert ground.range_m((5.5, 0.0, -1.5), straight_down) == pytest.approx(1.5)


def over_the_slope(rangefinder_type: int) -> list[tuple[float, float]]:
    """Fly uphill for six seconds without touching the throttle; return (height over ground, over the start)."""
    vehicle = Vehicle(Airframe(shiver_rad=0.0), ground=UPHILL)
    vehicle.down_m, vehicle.on_ground = -1.5, False
    settings = FlightSettings.of(ParameterTable({"RNGFND1_TYPE": rangefinder_type}))
    control = FlightControl(vehicle, settings)
    control.arm()
    control.landed = False
    control.set_mode(Mode.ALT_HOLD)
    pilot = PilotInput(0.0, -0.15, 0.0, 500.0, 500.0, True)
    heights = []
    for _ in range(round(6.0 / STEP_S)):
        control.step(pilot)
        vehicle.step()
        heights.append((vehicle.height_m, -vehicle.down_m))
    assert vehicle.north_m > 4.0
    return heights


def test_with_a_rangefinder_it_keeps_over_the_ground_and_without_one_over_the_start() -> None:
    tracking, holding = over_the_slope(10), over_the_slope(0)
    # behind by SURFTRAK_TC, 1 s, of climbing at 0.4 m/s
    assert all(abs(height - 1.5) < 0.55 for height, _ in tracking)
    assert all(abs(altitude - 1.5) < 0.1 for _, altitude in holding)
    assert holding[-1][0] < 0.9


def test_the_rangefinder_reports_what_is_below() -> None:
    ground = Ground(bushes=np.array([[0.0, 0.0, -0.5, 0.4, 0.4, 0.5]]))
    vehicle = Vehicle(Airframe(shiver_rad=0.0), ground=ground)
    vehicle.down_m, vehicle.on_ground = -1.5, False
    vehicle._record()
    estimator = Estimator(vehicle, ParameterTable({"RNGFND1_TYPE": 10}), NOISELESS, 1, 0.0)
    assert estimator.estimate().range_m == pytest.approx(0.5, abs=0.01)
    assert vehicle.surface_m == pytest.approx(1.0)
