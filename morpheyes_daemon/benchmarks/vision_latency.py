"""How long seeing takes on this machine: rendering a pair, one depth map, a frame through the vision worker.

Pairs are rendered from the forest at flying height along the course. Kinds that are compared take turns in one run,
so that whatever else the machine does falls on both.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from morpheyes_daemon.clock import S, VirtualClock, VirtualLoop, stopwatch_s
from morpheyes_daemon.flights.lockstep import FlightPlan
from morpheyes_daemon.flights.sim_vehicle import SimVehicle
from morpheyes_daemon.messages.core import BaselineEstimate, Perception, RawPair, StereoFrame, VehicleState
from morpheyes_daemon.perception.pipeline import PipelineFactory, VisionJob
from morpheyes_daemon.stereo.calibration_file import read_calibration
from morpheyes_daemon.stereo.depth import DepthEstimator
from morpheyes_daemon.transforms import Array, pose
from morpheyes_daemon.vision_worker.process import ProcessWorker

HEIGHT_M = 1.5
BASELINE_M = 0.2
STEP_M = 1.0
WARM_UP = 2
JOB_TIMEOUT_S = 60.0

Report = Callable[[str, int, int], None]


@dataclass(frozen=True, slots=True)
class Times:
    """Milliseconds over repeated runs."""

    repeats: int
    median_ms: float
    p95_ms: float
    max_ms: float

    @classmethod
    def of(cls, seconds: Sequence[float]) -> Times:
        """Summarize."""
        p50, p95 = (float(value) * 1e3 for value in np.percentile(seconds, (50.0, 95.0)))
        return cls(len(seconds), p50, p95, max(seconds) * 1e3)


@dataclass(frozen=True, slots=True)
class DepthBench:
    """Our depth map beside OpenCV's own matcher on the same rectified pair; `ratio` is median over median."""

    size: str
    disparities: int
    depth: Times
    opencv: Times
    ratio: float


@dataclass(frozen=True, slots=True)
class LatencyBench:
    """From handing a frame to the vision worker to its percept, beside what lockstep reckons with."""

    size: str
    latency: Times
    compute: Times
    configured_ms: float


class Rig:
    """Renders pairs of a plan's world from flying height."""

    def __init__(self, plan: FlightPlan) -> None:
        loop = VirtualLoop()
        self._loop = loop
        self._stage = SimVehicle(plan.scenario, plan.config, VirtualClock(loop), plan.threads)

    def pair(self, k: int) -> RawPair:
        """Render the k-th pair of the course."""
        place = pose(np.eye(3), np.array([STEP_M * (k % 40), 0.0, -HEIGHT_M]))

        def pose_at(t_ns: int) -> Array:
            return place

        return self._stage.camera.render_pair(round((k + 1) * S / 5), k, pose_at, BASELINE_M)

    def close(self) -> None:
        """End the render threads."""
        self._stage.close()
        self._loop.close()


def bench_render(plan: FlightPlan, repeats: int, report: Report) -> Times:
    """Time the rendering of pairs."""
    rig, seconds = Rig(plan), []
    try:
        for k in range(repeats + WARM_UP):
            started_s = stopwatch_s()
            rig.pair(k)
            seconds.append(stopwatch_s() - started_s)
            report("rendering", k + 1, repeats + WARM_UP)
    finally:
        rig.close()
    return Times.of(seconds[WARM_UP:])


def bench_depth(plan: FlightPlan, repeats: int, report: Report) -> DepthBench:
    """Time our depth map and OpenCV's matcher with the same search range, in turns."""
    width, height = plan.config.camera.width_px, plan.config.camera.height_px
    estimator = DepthEstimator(read_calibration(plan.calibration), plan.config.stereo, (width, height))
    disparities = -(-round(plan.config.stereo.disparities_fraction * width) // 16) * 16
    matcher = opencv_matcher(disparities)
    ours, theirs = [], []
    for k, frame in enumerate(_frames(plan, repeats + WARM_UP)):
        pair = estimator.rectified(frame)
        started_s = stopwatch_s()
        estimator.depth(frame, pair)
        between_s = stopwatch_s()
        matcher.compute(pair.left, pair.right)
        ours.append(between_s - started_s)
        theirs.append(stopwatch_s() - between_s)
        report("matching", k + 1, repeats + WARM_UP)
    depth, opencv = Times.of(ours[WARM_UP:]), Times.of(theirs[WARM_UP:])
    return DepthBench(f"{width}x{height}", disparities, depth, opencv, depth.median_ms / opencv.median_ms)


def opencv_matcher(disparities: int) -> cv2.StereoSGBM:
    """Return OpenCV's semi-global matcher as its samples set it up."""
    return cv2.StereoSGBM.create(
        numDisparities=disparities, blockSize=5, P1=200, P2=800, disp12MaxDiff=1, uniquenessRatio=10,
        mode=cv2.STEREO_SGBM_MODE_SGBM_3WAY,
    )  # fmt: skip


def bench_latency(plan: FlightPlan, repeats: int, report: Report) -> LatencyBench:
    """Time frames through the vision worker, strategy included."""
    frames = list(_frames(plan, repeats + WARM_UP))
    latency, compute = asyncio.run(_through_worker(plan, frames, report))
    camera = plan.config.camera
    size = f"{camera.width_px}x{camera.height_px}"
    configured_ms = plan.config.stereo.latency_ms
    return LatencyBench(size, Times.of(latency[WARM_UP:]), Times.of(compute[WARM_UP:]), configured_ms)


async def _through_worker(
    plan: FlightPlan, frames: list[StereoFrame], report: Report
) -> tuple[list[float], list[float]]:
    factory = PipelineFactory(plan.config, plan.mission, read_calibration(plan.calibration))
    worker: ProcessWorker[VisionJob, Perception] = ProcessWorker(factory, job_timeout_s=JOB_TIMEOUT_S)
    latency, compute = [], []
    await worker.start()
    try:
        for k, frame in enumerate(frames):
            vehicle = replace(VehicleState(), t_ns=frame.t_ns, p_ned_m=(0.0, 0.0, -HEIGHT_M), height_m=HEIGHT_M)
            started_s = stopwatch_s()
            seen = await worker.compute(VisionJob(frame, vehicle, keep_images=True))
            latency.append(stopwatch_s() - started_s)
            compute.append(seen.summary.compute_s)
            report("seeing", k + 1, len(frames))
    finally:
        await worker.close()
    return latency, compute


def _frames(plan: FlightPlan, count: int) -> list[StereoFrame]:
    rig = Rig(plan)
    try:
        pairs = [rig.pair(k) for k in range(min(count, 8))]
    finally:
        rig.close()
    frames = []
    for k in range(count):
        pair = pairs[k % len(pairs)]
        at = BaselineEstimate(pair.t_ns, BASELINE_M, BASELINE_M, 1e-4, False)
        frames.append(StereoFrame(k + 1, pair.t_ns, pair.left, pair.right, at))
    return frames
