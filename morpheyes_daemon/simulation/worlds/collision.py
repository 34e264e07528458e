"""How far the vehicle is from what it could hit: the simulator's and the judges' truth, never the daemon's.

The vehicle is an elliptic cylinder over the propeller tips and the box of the stereo bar, as long as the present
baseline makes it, both leaning with the body. The ground does not count: it is for the vehicle twin to land on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from morpheyes_daemon.config.mount_pose import T_frd_rig
from morpheyes_daemon.config.vehicle import Footprint, Mount
from morpheyes_daemon.simulation.rendering.meshes import icosphere
from morpheyes_daemon.simulation.worlds.gjk import BOX, CYLINDER, ELLIPSOID, FRUSTUM, PRISM, nearest
from morpheyes_daemon.transforms import Array, pose

SIZE = 9
_DIRECTIONS = np.ascontiguousarray(icosphere(2)[0])


@dataclass(frozen=True, slots=True, eq=False)
class Solid:
    """A convex body: kind and size as `convex` has them, and its pose (4, 4)."""

    kind: int
    T: Array
    size: tuple[float, ...]

    @property
    def capsule(self) -> tuple[float, ...]:
        """Ends of an axis (world frame) and a radius that enclose it."""
        extent = np.array(self._extent())
        if self.kind in (BOX, PRISM):
            axis = int(np.argmax(extent))
            radius, half = float(np.linalg.norm(np.delete(extent, axis))), float(extent[axis])
        elif self.kind == ELLIPSOID:
            axis, radius, half = 2, float(extent.max()), 0.0
        else:
            axis, radius, half = 2, float(extent[:2].max()), float(extent[2])
        end = half * self.T[:3, axis]
        return (*(self.T[:3, 3] - end), *(self.T[:3, 3] + end), radius)

    def _extent(self) -> tuple[float, float, float]:
        size = self.size
        if self.kind == FRUSTUM:
            return max(size[:2]), max(size[:2]), size[2]
        if self.kind == PRISM:
            return max(abs(c) for c in size[0:8:2]), max(abs(c) for c in size[1:8:2]), size[8]
        return size[0], size[1], size[2]


def frustum_solid(base: Array, top: Array, radius_base_m: float, radius_top_m: float) -> Solid:
    """Return a tapered cylinder between two points (3,)."""
    axis = top - base
    height = float(np.linalg.norm(axis))
    T = pose(_frame_along(axis / height), 0.5 * (base + top))
    return Solid(FRUSTUM, T, (radius_base_m, radius_top_m, height / 2))


def ellipsoid_solid(centre: Array, radii: Array) -> Solid:
    """Return an ellipsoid with axes along the world's."""
    return Solid(ELLIPSOID, pose(np.eye(3), centre), (float(radii[0]), float(radii[1]), float(radii[2])))


def box_solid(T: Array, edges_m: tuple[float, float, float]) -> Solid:
    """Return a box of given edges at pose T (4, 4)."""
    return Solid(BOX, T, (edges_m[0] / 2, edges_m[1] / 2, edges_m[2] / 2))


def prism_solid(T: Array, corners_m: Array, thickness_m: float) -> Solid:
    """Return a convex quadrilateral, or a triangle, (4 or 3, 2) in the xy plane of pose T, thickened along z."""
    middle = 0.5 * (corners_m.min(axis=0) + corners_m.max(axis=0))
    moved = T @ pose(np.eye(3), np.array([*middle, 0.0]))
    corners = (corners_m - middle)[[0, 1, 2, -1]]
    return Solid(PRISM, moved, (*corners.ravel().tolist(), thickness_m / 2))


def _frame_along(z: Array) -> Array:
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


class Obstacles:
    """Solids in one frame, laid out for `convex.nearest`."""

    def __init__(self, solids: Sequence[Solid]) -> None:
        n = len(solids)
        self._kinds = np.array([s.kind for s in solids], np.int64)
        self._frames = np.array([s.T[:3] for s in solids], np.float64).reshape(n, 3, 4)
        self._sizes = np.zeros((n, SIZE))
        for i, solid in enumerate(solids):
            self._sizes[i, : len(solid.size)] = solid.size
        self._capsules = np.array([s.capsule for s in solids], np.float64).reshape(n, 7)

    def nearest_m(self, body: Solid, limit_m: float = np.inf) -> float:
        """Return the signed distance from `body` to the nearest solid, or `limit_m` if all are farther."""
        size = np.zeros(SIZE)
        size[: len(body.size)] = body.size
        reach = float(np.linalg.norm(body._extent()))
        found = nearest(
            self._kinds, self._frames, self._sizes, body.kind, np.ascontiguousarray(body.T[:3]), size, reach,
            self._capsules, limit_m, _DIRECTIONS,
        )  # fmt: skip
        return float(found)


@dataclass(frozen=True, slots=True, eq=False)
class MovingObstacles:
    """Solids in the frame of an object that moves as `T_ned_object(t_s)` says."""

    obstacles: Obstacles
    T_ned_object: Callable[[float], Array]


@dataclass(frozen=True, slots=True)
class VehicleShape:
    """Hull and stereo bar as solids."""

    footprint: Footprint = Footprint()
    mount: Mount = Mount()

    def solids(self, p_ned_m: Array, R_ned_frd: Array, baseline_m: float) -> tuple[Solid, Solid]:
        """Return hull and bar in ned at a pose and baseline."""
        f = self.footprint
        T_ned_frd = pose(R_ned_frd, p_ned_m)
        hull = Solid(CYLINDER, T_ned_frd, (f.hull_length_mm / 2e3, f.hull_width_mm / 2e3, f.hull_height_mm / 2e3))
        bar_m = baseline_m + f.camera_width_mm / 1e3
        # rig axes: x along the bar, y down, z forward
        bar = box_solid(T_ned_frd @ T_frd_rig(self.mount), (bar_m, f.bar_height_mm / 1e3, f.bar_depth_mm / 1e3))
        return hull, bar


class CollisionWorld:
    """All that can be hit, standing and moving."""

    def __init__(self, standing: Sequence[Solid], moving: Sequence[MovingObstacles] = ()) -> None:
        self._standing = Obstacles(standing)
        self._moving = tuple(moving)

    def clearance_m(
        self, p_ned_m: Array, R_ned_frd: Array, shape: VehicleShape, baseline_m: float, t_s: float = 0.0
    ) -> float:
        """Return the signed distance from the vehicle to the nearest obstacle at world time `t_s`.

        Exact to 0.1 mm when positive; negative means overlap, its depth being an upper estimate.
        """
        best = np.inf
        for body in shape.solids(p_ned_m, R_ned_frd, baseline_m):
            best = self._standing.nearest_m(body, best)
            for group in self._moving:
                T_object_ned = np.linalg.inv(group.T_ned_object(t_s))
                best = group.obstacles.nearest_m(Solid(body.kind, T_object_ned @ body.T, body.size), best)
        return best
