"""Wind: intensity, length scale and shear as the standard has them, and the same for the same seed."""

import math
import statistics

import pytest

from morpheyes_daemon.simulation.airframe.wind import Wind, WindConditions

FT_M = 0.3048


def record(conditions: WindConditions, height_m: float, seed: int = 1, steps: int = 40_000) -> list[tuple[float, ...]]:
    wind = Wind(conditions, seed)
    rows: list[tuple[float, ...]] = []
    for _ in range(steps):
        wind.advance(0.05, height_m, 0.0)
        rows.append(wind.velocity_ned_m_s)
    return rows


def test_calm_air_stands_still() -> None:
    assert set(record(WindConditions(), 2.0, steps=100)) == {(0.0, 0.0, 0.0)}


def test_gusts_have_the_dryden_intensity_at_ten_feet() -> None:
    """sigma_w = 0.1 W20 and sigma_u = sigma_w / 0.185^0.4; 2000 s hold about 170 length scales: 10 %."""
    rows = record(WindConditions(4.0), 10 * FT_M)
    sigma_u = 0.4 / (0.177 + 0.00823) ** 0.4
    assert statistics.pstdev(row[1] for row in rows) == pytest.approx(sigma_u, rel=0.1)
    assert statistics.pstdev(row[2] for row in rows) == pytest.approx(0.4, rel=0.1)


def test_gusts_lose_memory_over_the_length_scale() -> None:
    rows = [row[1] for row in record(WindConditions(4.0), 10 * FT_M)]
    length_m = 10 * FT_M / (0.177 + 0.00823) ** 1.2
    lag = round(length_m / 4.0 / 0.05)
    variance = statistics.pvariance(rows)
    covariance = statistics.fmean(a * b for a, b in zip(rows, rows[lag:], strict=False))
    assert covariance / variance == pytest.approx(math.exp(-1.0), abs=0.12)


def test_the_mean_blows_from_where_it_comes_and_falls_towards_the_ground() -> None:
    high = record(WindConditions(5.0, math.pi / 2, gust_fraction=0.0), 20 * FT_M, steps=1)[0]
    assert high[1] == pytest.approx(-5.0, rel=1e-9)
    assert high[0] == pytest.approx(0.0, abs=1e-9)
    low = record(WindConditions(5.0, math.pi / 2, gust_fraction=0.0), 1.5, steps=1)[0]
    assert low[1] == pytest.approx(-5.0 * math.log(1.5 / FT_M / 0.15) / math.log(20 / 0.15), rel=1e-9)
    assert record(WindConditions(5.0, gust_fraction=0.0), 0.0, steps=1)[0][:2] == (0.0, 0.0)


def test_the_same_seed_gives_the_same_wind() -> None:
    assert record(WindConditions(3.0), 2.0, 7, 50) == record(WindConditions(3.0), 2.0, 7, 50)
    assert record(WindConditions(3.0), 2.0, 7, 50) != record(WindConditions(3.0), 2.0, 8, 50)
