"""How long finding a gap takes on one core, with and without the depth, beside a detector by stacked optical flow.

Views are rendered before gap walls of every shape; all kinds take turns on the same views, with one thread, so that
whatever else the machine does falls on all of them.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from morpheyes_daemon.benchmarks.gapflyt_baseline import STACK, flow_gap, stacked_flow
from morpheyes_daemon.benchmarks.vision_latency import WARM_UP, Report, Times
from morpheyes_daemon.campaigns.gap_ground_truth import filled, iou, true_masks
from morpheyes_daemon.clock import S, VirtualClock, VirtualLoop, processor_s, stopwatch_s
from morpheyes_daemon.flights.flight_plan import with_seed
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import BaselineEstimate, Image, RawPair, StereoFrame, VehicleState
from morpheyes_daemon.perception.craft import build_strategy
from morpheyes_daemon.simulation.worlds.world import GapTruth
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.depth import DepthEstimator, grey
from morpheyes_daemon.strategies.base import View
from morpheyes_daemon.strategies.gap.perception import GapPercept
from morpheyes_daemon.transforms import Array, pose

RANGES_M = (5.0, 3.4, 2.0)
"""From the wall: on the way, at the stand-off, on the run."""

GAIN = 0.05
STEP_M = 0.04
"""Between the frames of the flow's stack, sideways."""


@dataclass(frozen=True, slots=True)
class GapBench:
    """Times of detection on one depth image, of the depth itself, and of the flow detector on its stack.

    `detection_cpu` is what detection takes of the processor, which other work on the machine does not lengthen.
    `ratio` is the flow's median over detection's, `ratio_with_depth` over detection and depth together; the IoUs are
    medians against the truth over the views.
    """

    size: str
    views: int
    detection: Times
    detection_cpu: Times
    depth: Times
    flow: Times
    ratio: float
    ratio_with_depth: float
    contour_iou: float
    flow_iou: float


@dataclass(frozen=True, slots=True, eq=False)
class GapView:
    """One place before a wall: stereo frame, vehicle, further raw left images for the flow, and what only the twin
    knows: the wall and the true pose of the left eye."""

    frame: StereoFrame
    vehicle: VehicleState
    stack: tuple[Image, ...]
    gap: GapTruth
    T_ned_cam0: Array


class GapBencher:
    """Both detectors on the same views."""

    def __init__(self, plan: FlightPlan) -> None:
        size = (plan.config.camera.width_px, plan.config.camera.height_px)
        self._estimator = DepthEstimator(read_calibration(plan.calibration), plan.config.stereo, size)
        self._strategy = build_strategy(plan.mission, plan.config)
        self.seconds: dict[str, list[float]] = {"detection": [], "detection_cpu": [], "depth": [], "flow": []}
        self.ious: dict[str, list[float]] = {"detection": [], "flow": []}

    def run(self, view: GapView) -> None:
        """Time both detectors on a view and hold what they found against the truth."""
        pair = self._estimator.rectified(view.frame)
        rectified = pair.rectification
        started_s = stopwatch_s()
        pair = self._estimator.rectified(view.frame)
        depth = self._estimator.depth(view.frame, pair)
        self.seconds["depth"].append(stopwatch_s() - started_s)
        seen = View(depth, pair.left, pair.right, view.vehicle, self._strategy.craft.T_frd_rig)
        started_s, started_cpu_s = stopwatch_s(), processor_s()
        percept: GapPercept = self._strategy.perceive(seen)
        self.seconds["detection_cpu"].append(processor_s() - started_cpu_s)
        self.seconds["detection"].append(stopwatch_s() - started_s)
        others = [rectified.pair(grey(image), grey(image))[0] for image in view.stack]
        started_s = stopwatch_s()
        slow = flow_gap(stacked_flow(pair.left, others))
        self.seconds["flow"].append(stopwatch_s() - started_s)
        truth = true_masks(view.gap, view.gap.T_ned_wall(0.0), view.T_ned_cam0, rectified)[0]
        contours = [filled(opening.contour_px, rectified.pinhole) for opening in percept.openings]
        self.ious["detection"].append(max((iou(contour, truth) for contour in contours), default=0.0))
        self.ious["flow"].append(iou(slow, truth))


def bench_gap(plan: FlightPlan, repeats: int, report: Report) -> GapBench:
    """Time both detectors on `repeats` views."""
    bencher, threads = GapBencher(plan), cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        for k in range(repeats + WARM_UP):
            bencher.run(gap_view(plan, k))
            report("gap views", k + 1, repeats + WARM_UP)
    finally:
        cv2.setNumThreads(threads)
    names = ("detection", "detection_cpu", "depth", "flow")
    detection, detection_cpu, depth, flow = (Times.of(bencher.seconds[name][WARM_UP:]) for name in names)
    camera = plan.config.camera
    return GapBench(
        f"{camera.width_px}x{camera.height_px}",
        repeats,
        detection,
        detection_cpu,
        depth,
        flow,
        flow.median_ms / detection.median_ms,
        flow.median_ms / (detection.median_ms + depth.median_ms),
        float(np.median(bencher.ious["detection"][WARM_UP:])),
        float(np.median(bencher.ious["flow"][WARM_UP:])),
    )


def gap_view(plan: FlightPlan, k: int, stack: int = STACK) -> GapView:
    """Render the k-th view: another wall every time, the ranges in turn, a little off the opening's axis."""
    loop = VirtualLoop()
    stage = SimVehicle(with_seed(plan, k).scenario, plan.config, VirtualClock(loop))
    rng = np.random.default_rng(k)
    range_m = RANGES_M[k % len(RANGES_M)]
    gap = stage.world.gaps[0]
    T_ned_wall = gap.T_ned_wall(0.0)
    y, z = gap.outlines[0].mean(axis=0) + rng.normal(0.0, 0.1, 2)
    place = (T_ned_wall @ np.array([-range_m, y, z, 1.0]))[:3]
    nominal_m = float(np.clip(GAIN * range_m, *plan.config.baseline_range_m))
    actual_m = stage.rig.actual_m(nominal_m)
    t_ns = round((k + 1) * S / 5)

    def left_at(aside_m: float, seq: int) -> RawPair:
        body = pose(np.eye(3), place + np.array([0.0, aside_m, 0.0]))
        return stage.camera.render_pair(t_ns, seq, lambda _: body, actual_m)

    pair = left_at(0.0, 0)
    others = tuple(left_at(STEP_M * (j + 1), j + 1).left for j in range(stack))
    T_ned_cam0 = stage.camera.T_ned_eye(0, pose(np.eye(3), place), actual_m)
    stage.close()
    loop.close()
    frame = StereoFrame(k, t_ns, pair.left, pair.right, BaselineEstimate(t_ns, nominal_m, nominal_m, 1e-4, False))
    north, east, down = (float(x) for x in place)
    return GapView(frame, VehicleState(p_ned_m=(north, east, down)), others, gap, T_ned_cam0)
