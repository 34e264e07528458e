"""Many flights: every seed at every baseline, on one machine or on a Dask scheduler, resumable.

Each finished flight is one line of `flights.jsonl`; a campaign started again in the same folder flies only what is
missing. Flights are independent and indexed by seed, so the order in which they end does not matter, and one that
cannot be flown keeps none of the others from it. The first seed of every baseline leaves log, map, strips and film.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from morpheyes_daemon.campaigns.forest_table import Row
from morpheyes_daemon.campaigns.metrics import measures_for
from morpheyes_daemon.campaigns.results import Results, draw_figures, results_of
from morpheyes_daemon.errors import InputError, MorphEyesError, UsageError, mistake
from morpheyes_daemon.flights.artifacts import FlightArtifacts
from morpheyes_daemon.flights.flight_plan import hold, parse_baseline, with_seed
from morpheyes_daemon.flights.lockstep import FlightPlan, Watchers, fly
from morpheyes_daemon.simulation.worlds.loader import load_world
from morpheyes_daemon.stereo.calibration_file import read_calibration

FLIGHTS = "flights.jsonl"


@dataclass(frozen=True, slots=True)
class Campaign:
    """What is flown: `plan` with every baseline ('variable' or metres, as `parse_baselines` has it) and every seed."""

    plan: FlightPlan
    baselines: tuple[str, ...]
    seeds: tuple[int, ...]

    @property
    def key(self) -> str:
        """Hash of everything but seeds and baselines: rows of another key belong to another campaign."""
        plan = self.plan
        parts = (
            plan.mission_name,
            plan.mission.model_dump_json(),
            plan.config.model_dump_json(),
            hashlib.sha256(plan.calibration.read_bytes()).hexdigest(),
            repr(replace(plan.scenario, seed=0)),
            load_world(plan.scenario.world).model_dump_json(exclude={"description"}),
            repr(plan.limit_s),
        )
        return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]

    def settings(self) -> Row:
        """Return what a reader of the results wants to know."""
        plan = self.plan
        camera, stereo = plan.config.camera, plan.config.stereo
        return {
            "mission": plan.mission_name,
            "strategy": plan.mission.strategy,
            "world": plan.scenario.world,
            "image_size": f"{camera.width_px}x{camera.height_px}",
            "rate_hz": camera.rate_hz,
            "latency_ms": stereo.latency_ms,
            "disparities_fraction": stereo.disparities_fraction,
            "wind_m_s": plan.scenario.wind_m_s,
            "calibration": read_calibration(plan.calibration).origin,
            "seeds": [self.seeds[0], self.seeds[-1]],
            "baselines": list(self.baselines),
        }


def parse_seeds(text: str) -> tuple[int, ...]:
    """Return the seeds of '0-39' (inclusive) or '7'; raises UsageError."""
    first, dash, last = text.partition("-")
    if first.isdigit() and (last.isdigit() if dash else True):
        low, high = int(first), int(last) if dash else int(first)
        if low <= high:
            return tuple(range(low, high + 1))
    raise UsageError(f"--seeds {text}: give one seed or a range such as 0-39 (both ends are flown).")


def parse_baselines(text: str) -> tuple[str, ...]:
    """Return the baselines of a list such as 'variable,0.1,0.20' as rows name them; raises UsageError."""
    baselines: list[str] = []
    for item in text.split(","):
        if not item.strip():
            raise UsageError(f"--baselines {text}: an item is empty; give for instance variable,0.1.")
        metres = parse_baseline(item.strip())
        baseline = "variable" if metres is None else f"{metres:g}"
        if baseline in baselines:
            raise UsageError(f"--baselines {text}: {baseline} is there twice, but is flown once.")
        baselines.append(baseline)
    return tuple(baselines)


def require_jobs(jobs: int) -> None:
    """Refuse a number of flights at once that cannot be flown; raises UsageError."""
    if jobs < 1 and jobs != -1:
        raise UsageError(f"--jobs {jobs}: give how many flights to fly at once, or -1 for one per core.")


@dataclass(frozen=True, slots=True)
class Failure:
    """A flight that could not be flown, and what was raised."""

    baseline_mode: str
    seed: int
    text: str


def run_campaign(
    campaign: Campaign, folder: Path, jobs: int, scheduler: str | None, done: Callable[[Row, int, int], None]
) -> Results:
    """Fly what is missing, write what came of the whole, and return it in the order of baselines and seeds.

    `done` hears of each new row, with how many there are of how many. Results of an earlier campaign in the folder
    stay as they are until all flights are there. Raises InputError when the folder belongs to another campaign or one
    is running there, UsageError when the scheduler cannot be reached, and MorphEyesError, once all others have been
    flown and kept, when there are flights that cannot.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with _lock(folder):
        key, settings = campaign.key, campaign.settings()
        rows_file = folder / FLIGHTS
        rows = {(row["baseline_mode"], row["seed"]): row for row in _read(rows_file, key)}
        wanted = [(mode, seed) for mode in campaign.baselines for seed in campaign.seeds]
        missing = [pair for pair in wanted if pair not in rows]
        have = len(wanted) - len(missing)
        failures: list[Failure] = []
        with rows_file.open("a", encoding="utf-8") as file:
            for flown in _fly_all(campaign, missing, key, folder, jobs, scheduler):
                if isinstance(flown, Failure):
                    failures.append(flown)
                    continue
                rows[flown["baseline_mode"], flown["seed"]] = flown
                file.write(json.dumps(flown) + "\n")
                file.flush()
                have += 1
                done(flown, have, len(wanted))
        if failures:
            raise MorphEyesError(_told(failures, len(wanted)))
        results = results_of(campaign.plan, [rows[pair] for pair in wanted])
        results.write(folder, settings)
        draw_figures(campaign.plan, results.flights, folder)
    return results


def fly_one(plan: FlightPlan, key: str, folder: Path | None = None) -> Row:
    """Fly one plan and return its row, leaving log and pictures in `folder`; runs in a worker process."""
    measures = measures_for(plan)
    watchers = Watchers(attach=[measures.attach] if measures else [])
    outputs = FlightArtifacts(folder, plan) if folder else None
    if outputs:
        outputs.watch(watchers)
    summary = fly(plan, watchers)
    if outputs:
        outputs.finish(summary)
    return {**summary.as_json(), **(measures.row() if measures else {}), "campaign": key}


def _try_one(mode: str, plan: FlightPlan, key: str, folder: Path | None = None) -> Row | Failure:
    try:
        return fly_one(plan, key, folder)
    except Exception as error:  # noqa: BLE001 -- the worker's task boundary
        return Failure(mode, plan.scenario.seed, mistake(error))


def _try_elsewhere(mode: str, plan: FlightPlan, key: str, calibration: str, world: str | None) -> Row | Failure:
    """Fly on a machine that has none of our files: calibration and, unless it is a shipped one, world come as text."""
    with TemporaryDirectory(prefix="morpheyes-") as name:
        here = replace(plan, calibration=Path(name) / "calibration.yaml")
        here.calibration.write_text(calibration, encoding="utf-8")
        if world is not None:
            (Path(name) / "world.yaml").write_text(world, encoding="utf-8")
            here = replace(here, scenario=replace(plan.scenario, world=f"{name}/world.yaml"))
        flown = _try_one(mode, here, key)
    return flown if isinstance(flown, Failure) else {**flown, "world": plan.scenario.world}


def _texts(plan: FlightPlan) -> tuple[str, str | None]:
    """Return the text of a plan's calibration file, and of its world where that is a file."""
    world = Path(plan.scenario.world)
    return plan.calibration.read_text(encoding="utf-8"), world.read_text(encoding="utf-8") if world.is_file() else None


def _plan(campaign: Campaign, mode: str, seed: int) -> FlightPlan:
    plan = with_seed(campaign.plan, seed)
    return replace(plan, config=hold(plan.config, parse_baseline(mode)))


def _fly_all(
    campaign: Campaign, pairs: Sequence[tuple[str, int]], key: str, folder: Path, jobs: int, scheduler: str | None
) -> Iterator[Row | Failure]:
    """Fly; the first seed of every baseline leaves its pictures, when this machine does the flying."""
    plans = [(mode, _plan(campaign, mode, seed)) for mode, seed in pairs]
    if not plans:
        return
    if scheduler is not None:
        yield from _fly_on(scheduler, plans, key)
        return
    import joblib

    def pictures(mode: str, seed: int) -> Path | None:
        return folder / f"{mode}-{seed}" if seed == campaign.seeds[0] else None

    calls = [joblib.delayed(_try_one)(mode, plan, key, pictures(mode, plan.scenario.seed)) for mode, plan in plans]
    yield from joblib.Parallel(n_jobs=jobs, return_as="generator_unordered")(calls)


def _fly_on(scheduler: str, plans: Sequence[tuple[str, FlightPlan]], key: str) -> Iterator[Row | Failure]:
    """Fly on the workers of a Dask scheduler, in the order in which they get ready."""
    try:
        from distributed import Client, as_completed
    except ImportError:
        raise UsageError("--scheduler needs the campaign extra: pip install 'morpheyes-daemon[campaign]'.") from None
    try:
        client: Any = Client(scheduler, timeout="10s")  # type: ignore[no-untyped-call]
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {scheduler}: no Dask scheduler answers there ({error}).") from None
    with client:
        flights = {}
        for mode, plan in plans:
            flight = client.submit(_try_elsewhere, mode, plan, key, *_texts(plan), pure=False)
            flights[flight] = mode, plan.scenario.seed
        for flight in as_completed(flights):  # type: ignore[no-untyped-call]
            try:
                flown = flight.result()
            except Exception as error:  # noqa: BLE001 -- whatever became of a worker
                flown = Failure(*flights[flight], f"{type(error).__name__}: {error}")
            flight.release()  # or a worker that dies has all that it ever flew flown again
            yield flown


def _told(failures: Sequence[Failure], total: int) -> str:
    """Return one sentence that names every flight that failed, those that failed in the same way together."""
    alike: dict[tuple[str, str], list[int]] = {}
    for failure in sorted(failures, key=lambda failure: failure.seed):
        alike.setdefault((failure.baseline_mode, failure.text), []).append(failure.seed)
    named = [
        f"{mode}, seed{'s' if len(seeds) > 1 else ''} {', '.join(map(str, seeds))}: {text}"
        for (mode, text), seeds in alike.items()
    ]
    return (
        f"{len(failures)} of {total} flights could not be flown: {'; '.join(named)}; "
        "they are tried again when the campaign is started again."
    )


@contextlib.contextmanager
def _lock(folder: Path) -> Iterator[None]:
    with (folder / "campaign.lock").open("w", encoding="utf-8") as file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise InputError(f"{folder}: another campaign is running there; give another --out.") from None
        yield


def _read(path: Path, key: str) -> list[Row]:
    """Rows already flown; a last line that was cut off is dropped. Raises InputError on another campaign's rows."""
    if not path.is_file():
        return []
    rows: list[Row] = []
    lines = path.read_text(encoding="utf-8").splitlines()
    for number, line in enumerate(lines):
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            if number + 1 < len(lines):
                raise InputError(f"{path}:{number + 1}: is not a flight; give another --out.") from None
    if any(row.get("campaign") != key for row in rows):
        raise InputError(f"{path.parent}: holds flights of another campaign; give another --out.")
    if not path.read_bytes().endswith(b"\n"):
        whole = path.with_suffix(".whole")
        whole.write_text("".join(json.dumps(row) + "\n" for row in rows), encoding="utf-8")
        whole.replace(path)
    return rows
