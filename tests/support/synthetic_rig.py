"""A rig known in closed form and the corners that its eyes would see: truth for the calibration's tests, no pictures."""

import numpy as np
from numpy.typing import NDArray

from morpheyes_daemon.calibration.solver.rectification_residuals import StereoGeometry
from morpheyes_daemon.calibration.targets.boards import Board
from morpheyes_daemon.calibration.targets.observations import Observations
from morpheyes_daemon.stereo.intrinsics import CameraIntrinsics
from morpheyes_daemon.transforms import Array, R_from_rotvec, pose

WIDTH, HEIGHT = 640, 480
BOARD = Board(9, 6, 0.030)
CAM0 = CameraIntrinsics(WIDTH, HEIGHT, 742.0, 740.5, 322.3, 236.1, 3e-4, (-0.28, 0.11, 8e-4, -5e-4, -0.02))
CAM1 = CameraIntrinsics(WIDTH, HEIGHT, 737.0, 736.2, 316.4, 243.9, -2e-4, (-0.27, 0.10, -6e-4, 4e-4, -0.01))
TEN_M: NDArray[np.float64] = np.linspace(0.1, 0.3, 10)
_MARGIN_PX = 5.0


def true_pose(baseline_m: float) -> Array:
    """T_cam0_cam1 of a rail that bends smoothly: third order in one rotation, second in the length."""
    s = (baseline_m - 0.2) / 0.1
    turn_deg = [0.3 + 0.1 * s + 0.05 * s * s, -0.4 + 0.15 * s - 0.06 * s**3, 0.2 - 0.08 * s]
    t = [baseline_m + 0.001 * s * s - 0.0008 * s, 0.002 + 0.0012 * s, -0.003 + 0.0015 * s - 0.0005 * s * s]
    return pose(R_from_rotvec(np.radians(turn_deg)), np.array(t))


def true_geometry(baseline_m: float) -> StereoGeometry:
    return StereoGeometry(CAM0, CAM1, true_pose(baseline_m))


def observations(
    nominal_m: NDArray[np.float64] = TEN_M,
    views: int = 10,
    noise_px: float = 0.0,
    seed: int = 0,
    play_m: float = 0.0,
    square_factor: float = 1.0,
) -> Observations:
    """Corners of boards at drawn poses; `play_m` is the scatter of the true length about its smooth course."""
    rng = np.random.default_rng(seed)
    seen = []
    for index, nominal in enumerate(nominal_m):
        T_cam0_cam1 = true_pose(float(nominal) + play_m * rng.standard_normal())
        for _ in range(views):
            seen.append((index, *_board_view(T_cam0_cam1, float(nominal), rng)))
    left, right = (np.array([view[eye] for view in seen]) for eye in (1, 2))
    noise = noise_px * rng.standard_normal((2, *left.shape))
    board = Board(BOARD.columns, BOARD.rows, BOARD.square_m * square_factor)
    names = tuple((f"{index}mm/left{k}.png", f"{index}mm/right{k}.png") for k, (index, *_) in enumerate(seen))
    baseline = np.array([view[0] for view in seen])
    return Observations(board, (WIDTH, HEIGHT), nominal_m, baseline, names, left + noise[0], right + noise[1])


def _board_view(T_cam0_cam1: Array, baseline_m: float, rng: np.random.Generator) -> tuple[Array, Array]:
    points = BOARD.points_m - BOARD.points_m.mean(axis=0)
    while True:
        z = rng.uniform(0.4, 1.3)
        middle = np.array([rng.uniform(-0.4, 0.4) * z + baseline_m / 2, rng.uniform(-0.3, 0.3) * z, z])
        p_cam0 = points @ R_from_rotvec(rng.normal(0.0, 0.35, 3)).T + middle
        p_cam1 = (p_cam0 - T_cam0_cam1[:3, 3]) @ T_cam0_cam1[:3, :3]
        left, right = CAM0.project(p_cam0), CAM1.project(p_cam1)
        if _inside(left) and _inside(right):
            return left, right


def _inside(pixels: Array) -> bool:
    return bool(np.all((pixels > _MARGIN_PX) & (pixels < [WIDTH - _MARGIN_PX, HEIGHT - _MARGIN_PX])))
