"""Worlds keep their promises: density, gaps, no carved path; bad files are refused with a sentence."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from morpheyes_daemon.config.yaml_errors import parse_model
from morpheyes_daemon.errors import ConfigError
from morpheyes_daemon.simulation.rendering.scene import Light
from morpheyes_daemon.simulation.worlds.collision import VehicleShape
from morpheyes_daemon.simulation.worlds.forest_world import ForestWorld, plant
from morpheyes_daemon.simulation.worlds.loader import Daylight, WorldFile, build_world, load_world, world_names
from morpheyes_daemon.simulation.worlds.trees import Tree

CONTROL_RADIUS_M = 0.17
"""Footprint of the straight-line control run."""


def default_forest() -> ForestWorld:
    world = load_world("forest").world
    assert isinstance(world, ForestWorld)
    return world


def centre_at(tree: Tree, height_m: float) -> tuple[float, float, float]:
    middle = tree.base + height_m / tree.height_m * (tree.top - tree.base)
    return float(middle[0]), float(middle[1]), tree.radius_at_m(height_m)


def straight_line_collides(trees: list[Tree], course_m: float) -> bool:
    for tree in trees:
        x, y, radius = centre_at(tree, 1.5)
        beside = math.hypot(x - min(max(x, 0.0), course_m), y)
        if beside < radius + CONTROL_RADIUS_M:
            return True
    return False


def test_flying_straight_on_collides_in_three_of_four_forests() -> None:
    world = default_forest()
    collided = [straight_line_collides(plant(world, seed), world.course_m) for seed in range(40)]
    assert sum(collided) >= 30


@pytest.mark.parametrize("trees_per_ha", [100, 400, 1000])
def test_forest_has_its_density_and_its_gaps(trees_per_ha: int) -> None:
    world = ForestWorld(kind="forest", trees_per_ha=trees_per_ha)
    trees = plant(world, seed=1)
    area_ha = (world.run_in_m + world.course_m + world.run_out_m) * 2 * world.half_width_m / 1e4
    assert len(trees) == round(trees_per_ha * area_ha)
    for height_m in (0.0, 1.5, 3.0):
        x, y, radius = np.array([centre_at(tree, height_m) for tree in trees]).T
        gap = np.hypot(x[:, None] - x, y[:, None] - y) - radius[:, None] - radius
        assert gap[~np.eye(len(trees), dtype=bool)].min() >= 0.8
    assert all(0.10 <= tree.radius_m <= 0.40 for tree in trees)


def test_only_the_ends_of_the_course_are_cleared() -> None:
    world = default_forest()
    nearest_to_line = []
    for seed in range(10):
        for tree in plant(world, seed):
            x, y, radius = tree.base[0], tree.base[1], tree.radius_m
            assert min(math.hypot(x, y), math.hypot(x - world.course_m, y)) >= world.clearing_m + radius
            if 3 < x < world.course_m - 3:
                nearest_to_line.append(abs(y))
    # as many trees stand within half a metre of the line as anywhere else
    nearest = np.array(nearest_to_line)
    assert np.count_nonzero(nearest < 0.5) == pytest.approx(10 * 74 * 1.0 * 0.04, rel=0.5)


def test_the_same_seed_plants_the_same_forest() -> None:
    a, b, other = (plant(default_forest(), seed) for seed in (3, 3, 4))
    assert all(np.array_equal(p.base, q.base) and p.radius_m == q.radius_m for p, q in zip(a, b, strict=True))
    assert not np.array_equal(a[0].base, other[0].base)


def test_all_shipped_worlds_can_be_built() -> None:
    for name in world_names():
        world = build_world(load_world(name), seed=0)
        assert len(world.scene.meshes) + len(world.scene.moving) > 0
        assert np.isfinite([*world.start_ned_m, *(world.goal_ned_m or ())]).all()


def test_a_world_is_found_by_name_or_by_path(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("world:\n  kind: forest\n  trees_per_ha: 50\n")
    mine = load_world(str(path)).world
    assert isinstance(mine, ForestWorld)
    assert mine.trees_per_ha == 50
    with pytest.raises(ConfigError, match="no world 'jungle'.*forest"):
        load_world("jungle")


def test_a_bad_world_file_names_line_and_key(tmp_path: Path) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("world:\n  kind: forest\n  trees_per_ha: -3\n")
    with pytest.raises(ConfigError, match=r"bad\.yaml:3: world\.trees_per_ha"):
        load_world(str(path))
    path.write_text("world:\n  kind: forest\n  tree_per_ha: 3\n")
    with pytest.raises(ConfigError, match="no such key"):
        load_world(str(path))
    path.write_text("world:\n  kind: swamp\n")
    with pytest.raises(ConfigError, match="swamp"):
        load_world(str(path))
    path.write_text("world:\n  kind: forest\n  radius_min_m: 0.3\n  radius_max_m: 0.2\n")
    with pytest.raises(ConfigError, match="radius_min_m"):
        load_world(str(path))


def test_bushes_stand_on_the_ground_and_can_be_hit() -> None:
    file = load_world("forest_bushes")
    world = build_world(file, 1)
    assert world.ground.bushes is not None
    x, y, z, _, _, up = world.ground.bushes[0]
    assert -2.3 < z - up < -0.4
    clearance = world.clearance_m(np.array([x, y, z]), np.eye(3), VehicleShape(), 0.2)
    assert clearance < 0.0


def test_trees_and_goal_of_a_slope_stand_on_it() -> None:
    file = load_world("forest_slope")
    world = build_world(file, 2)
    assert isinstance(file.world, ForestWorld)
    for tree in plant(file.world, 2)[:50]:
        ground_m = world.ground.height_m(float(tree.base[0]), float(tree.base[1]))
        # the foot is as deep as the lower side of the trunk
        assert -0.3 * tree.radius_m - 1e-9 <= -tree.base[2] - ground_m <= 1e-9
    assert world.goal_ned_m is not None
    assert -world.goal_ned_m[2] == pytest.approx(1.5 + world.ground.height_m(80.0, 0.0))
    ground = next(mesh for mesh in world.scene.meshes if mesh.material == "ground")
    off = [-z - world.ground.height_m(x, y) for x, y, z in ground.vertices_m[::17].tolist()]
    assert max(map(abs, off)) < 1e-9


def test_nothing_passes_between_the_trunks_of_a_row() -> None:
    world = build_world(load_world("forest_dead_end"), 0)
    shape = VehicleShape()
    places = (np.array([16.0, y, -1.5]) for y in np.arange(-5.0, 5.0, 0.05))
    assert all(world.clearance_m(place, np.eye(3), shape, 0.1) < 0.0 for place in places)


def test_the_sun_stands_where_the_file_says() -> None:
    light = load_world("forest_light").light
    assert light is not None
    north, east, down = light.light().direction
    assert math.degrees(math.atan2(east, north)) == pytest.approx(20.0)
    assert math.degrees(math.asin(-down)) == pytest.approx(15.0)
    clear = Daylight().light()
    assert clear.direction == pytest.approx(Light().direction, abs=2e-3)
    assert clear.sun == Light().sun


def test_a_mixed_course_on_a_slope_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "hill.yaml"
    forest = "{kind: forest, relief: {slope_deg: 5}}"
    path.write_text(f"world: {{kind: mixed, forest: {forest}, gap: {{kind: gap}}}}", encoding="utf-8")
    with pytest.raises(ConfigError, match="level"):
        load_world(str(path))


ROOM, WALL = "kind: room, length_m: 20, width_m: 8, height_m: 4", "kind: gap, half_width_m: 2, top_m: 3"
STAYS, LOW = "[9, 5, 0, 1.5]", "across_m: 0, height_m: 1.2"
FOREST = "kind: forest, course_m: 30"


@pytest.mark.parametrize(
    ("world", "words"),
    [
        (f"{WALL}, fit_width_mm: 900, openings: [{{slack: 5}}]", "opening 1, at least 4.50 x"),
        (f"{WALL}, fit_height_mm: 900, openings: [{{}}, {{slack: 4}}]", "opening 2, at least 1.67 x 3.60 m, reaches beyond"),
        (f"{WALL}, openings: [{{height_m: 2.4, slack: 5}}]", "from 1.2 m below the ground to 3 m above it"),
        ("kind: gap, half_width_m: 2, fit_height_mm: 2000, top_m: 9, openings: [{height_m: 0.8, slack: 2}]", "reaches beyond the wall"),
        (f"{WALL}, openings: [{{across_m: -2}}, {{across_m: 1.6}}]", "take at least 4.02 m side by side"),
        (f"{WALL}, fit_width_mm: 1100, openings: [{{}}, {{}}, {{}}]", "take at least 4.10 m side"),
        (f"{WALL}, openings: [{{{LOW}}}, {{shape: goku}}, {{{LOW}, shape: blob}}]", "openings 1 and 3 overlap"),
        (f"{WALL}, openings: [{{across_m: 0, slack: 4}}, {{across_m: 1}}]", "openings 1 and 2 overlap"),
        ("kind: gap, top_m: 3, half_width_m: 4, mural_m: 2, motion: {kind: periodic, turn_deg: 45}", "turns 2.8 m back"),
        ("kind: room, behind_m: 4, length_m: 4", "behind_m must be less than length_m"),
        (f"{ROOM}, pillars: [[5, 1, 0]]", "the pillar at 5, 1 m needs an edge"),
        (f"{ROOM}, pillars: [[5, 1, 0.4], [5, -4.5, 0.4]]", "the pillar at 5, -4.5 m stands outside the room"),
        (f"{ROOM}, pillars: [[18, 0, 0.4]]", "from -3 to 17 m along x, 4 m to both sides and 4 m up"),
        (f"{ROOM}, pillars: [[0.4, 0.4, 0.4]]", "the pillar at 0.4, 0.4 m stands on the start"),
        (f"{ROOM}, cube: {{waypoints: [{STAYS}, [12, 16.9, 0, 1.5]]}}", "the waypoint at 12 s takes the cube out"),
        (f"{ROOM}, cube: {{waypoints: [{STAYS}, [12, -2.9, 0, 1.5]]}}", "the waypoint at 12 s takes the cube out"),
        (f"{ROOM}, cube: {{waypoints: [{STAYS}, [12, 5, -3.9, 1.5]]}}", "the waypoint at 12 s takes the cube out"),
        (f"{ROOM}, cube: {{waypoints: [{STAYS}, [12, 5, 0, 3.9]]}}", "the waypoint at 12 s takes the cube out"),
        (f"{ROOM}, cube: {{scatter: 0.3, waypoints: [{STAYS}, [12, 12, 1, 1.5]]}}", "the waypoint at 12 s takes"),
        (f"{ROOM}, cube: {{waypoints: [{STAYS}, [12, 5, 0, 0.1]]}}", "the waypoint at 12 s has the cube in the ground"),
        (f"{ROOM}, cube: {{edge_mm: 1700, waypoints: [{STAYS}, [12, 6, 0, 1.5]]}}", "1.7 m, which stays 3.4 m up"),
        (f"{ROOM}, pillars: [[6, 1, 0.4]], cube: {{waypoints: [{STAYS}, [12, 6, 0.7, 1.5]]}}", "cube in a pillar"),
        (f"{ROOM}, cube: {{waypoints: [[9, 0.4, 0, 1.5], {STAYS.replace('9', '12')}]}}", "where the vehicle starts"),
        (f"{FOREST}, trees_per_ha: 1500, gap_m: 3", "1500 trees per hectare cannot stand 3 m apart"),
        (f"{FOREST}, undergrowth: {{bush_height_min_m: 2, bush_height_max_m: 1}}", "bush_height_min_m must not be greater"),
        (f"{FOREST}, rows: [[8, -50, 8, 5]]", r"the row \[8.0, -50.0, 8.0, 5.0\] leaves the forest"),
        (f"{FOREST}, rows: [[8, 5, 16, 5], [-2, 0.3, 5, 0.3]]", "stands on the start"),
        (f"{FOREST}, rows: [[30.4, -5, 30.4, 5]]", "stands on the goal"),
        (f"kind: mixed, forest: {{{FOREST}}}, gap: {{kind: gap, distance_m: 30}}", "the wall at 30 m must stand on the course"),
        (f"kind: mixed, forest: {{{FOREST}}}, gap: {{kind: gap, distance_m: 25}}", "the mural at 30 m stands on the goal"),
    ],
)  # fmt: skip
def test_a_world_that_cannot_be_is_refused_with_one_sentence(world: str, words: str) -> None:
    with pytest.raises(ConfigError, match=words) as caught:
        parse_model(f"world: {{{world}}}\n", WorldFile, "odd.yaml")
    told = str(caught.value)
    assert told.startswith("odd.yaml:1: world")
    assert len(told.splitlines()) == 1
    assert "found {" not in told


@pytest.mark.parametrize(
    "world",
    [
        f"{WALL}, openings: [{{across_m: -1.5}}, {{across_m: 1.5}}]",
        f"{WALL}, openings: [{{across_m: 0, height_m: 1.0}}, {{across_m: 0, height_m: 2.0}}]",
        "kind: gap, top_m: 3, half_width_m: 4, mural_m: 2, motion: {kind: none, turn_deg: 45}",
        f"{ROOM}, pillars: [[0.6, 0, 0.4], [16.9, 3.9, 0.4]]",
        f"{ROOM}, cube: {{waypoints: [[9, 16.8, 3.8, 3.8], [12, -2.8, -3.8, 0.2]]}}",
        f"{ROOM}, cube: {{waypoints: [[9, 0, 0, 3.5], [12, 5, 0, 1.5]]}}",
        f"{FOREST}, goal: false, rows: [[30, -5, 30, 5]]",
        f"kind: mixed, forest: {{{FOREST}}}, gap: {{kind: gap, distance_m: 27}}",
    ],
)
def test_what_is_merely_tight_is_taken(world: str) -> None:
    assert build_world(parse_model(f"world: {{{world}}}\n", WorldFile, "tight.yaml"), seed=1).scene.meshes


def test_a_mixed_course_keeps_its_forest_s_heading_and_scatters_its_cube() -> None:
    cube = "{scatter: 0.2, waypoints: [[0, 20, 0, 1.5], [9, 20, 0, 1.5]]}"
    forest = f"{{{FOREST}, trees_per_ha: 0, heading_deg: 90}}"
    text = f"world: {{kind: mixed, forest: {forest}, gap: {{kind: gap}}, cube: {cube}}}\n"
    first, second = (build_world(parse_model(text, WorldFile, "mixed.yaml"), seed) for seed in (1, 2))
    assert first.heading_rad == pytest.approx(math.pi / 2)
    places = [next(thing for thing in world.scene.moving if thing.name == "cube") for world in (first, second)]
    assert not np.allclose(places[0].T_ned_object(0.0), places[1].T_ned_object(0.0))
