"""Run experiments and benchmarks in processes with one thread each.

A case of an experiment leaves a file, so that an interrupted run continues where it stopped; the pieces of a benchmark are measured anew.
"""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from push_ident.errors import InputError, PushIdentError
from push_ident.identification.fitting.budget import Budget
from push_ident_sim.code_digest import CORE, SIM, code_digest, code_of
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth, truth_file
from push_ident_sim.studies.common.study import Benchmark, Case, CaseResult, CaseSettings, Experiment, Json, Settings, read_json, write_json
from push_ident_sim.workers import describe_machine, single_threads

Progress = Callable[[str, int, int], None]
"""Called with the part in progress, the number of finished parts and the number of all."""

_OF_ALL = (
    *("cell", "engines", "injected", "objects.py", "recordings"),
    *(f"studies/common/{name}.py" for name in ("measuring", "objects", "pushed", "study")),
)
"""Code of push_ident_sim that results of any study may depend on; what runs studies and presents results is left out."""
_Calls = Sequence[tuple[Callable[..., Any], tuple[Any, ...]]]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Which cases to run, and where."""

    folder: Path
    """Of results: one file a case in FOLDER/NAME/."""
    truth_folder: Path
    """Of ground-truth pushes; they are simulated when they are not there."""
    objects: tuple[str, ...] = ()
    """Those of the experiment to take; all when empty."""
    n_models: int = 10
    """Ground truths of each object."""
    seed: int = 0
    """Of the first ground truth; the others follow it."""
    variants: tuple[str, ...] = ()
    """Those of the experiment to run; all when empty."""
    jobs: int = 1
    """Processes, each with one thread."""
    max_seconds: float = 30.0
    """Budget of one solve, as in the paper [s of the processor]."""
    truth: TruthSettings = field(default_factory=TruthSettings)
    noise: CameraNoise = field(default_factory=CameraNoise)
    recordings: Path = Path("../shared/data")
    """Of recorded pushes, for the experiment `recorded`."""
    goals: int = 4
    """Of each object, for experiments that push to goals."""
    stop_after: float = math.inf
    """No case of an experiment begins later than this after the start [min]; those that are finished are then summarised."""

    def __post_init__(self) -> None:
        for name, lowest in (("n_models", 1), ("jobs", 1), ("seed", 0), ("goals", 1)):
            if getattr(self, name) < lowest:
                raise InputError(f"`{name}` is {getattr(self, name)}, expected at least {lowest}.")


def run_experiment(experiment: Experiment, options: RunOptions, on_progress: Progress | None = None) -> Json:
    """Run every case that has no result yet, and summarise all of them.

    Returns:
        What the run was (`experiment, objects, models, variants, seed, max_seconds, date, machine`), the cases that failed (`failed`: case
        and error), and the experiment's `summary`. Times are of the processor of the machine that ran the case.

    Raises InputError: no case gave a result, or a variant that the experiment does not have.
    """
    report, began = on_progress or (lambda what, done, total: None), time.monotonic()
    cases = cases_of(experiment, options)
    settings = CaseSettings(
        options.truth_folder,
        Budget(max_seconds=options.max_seconds, processor_time=True),
        options.truth,
        options.noise,
        options.recordings,
        options.goals,
    )
    folder = options.folder / experiment.name
    # Results of other settings or other code have other names, so that no mean is taken over both.
    digest = _digest(experiment, settings)
    files = {case: folder / f"{case.key}-{digest}.json" for case in cases}
    sealed = experiment.prepare(cases, folder) if experiment.prepare else None
    jobs = 1 if experiment.one_at_a_time else options.jobs
    with single_threads(jobs) as pool:
        truths = _missing_truths(experiment, options) if experiment.needs_truth else []
        run_calls(pool, truths, lambda done, first: report("simulating pushes", done, len(truths)))
        _run_missing(pool, experiment, files, settings, report, until=began + 60.0 * options.stop_after)
    outcomes = {case: read_json(files[case]) for case in cases if files[case].exists()}
    results = [CaseResult(case, outcome["values"]) for case, outcome in outcomes.items() if "values" in outcome]
    if not results:
        raise InputError(_no_result(experiment, options, list(outcomes.values())))
    summary = {**experiment.summarise(results), **({} if sealed is None else {"sealed": sealed})}
    return {
        **{key: summary[key] for key in experiment.headline},
        "experiment": experiment.name,
        "objects": list(_objects(experiment, options)),
        "models": options.n_models,
        "variants": list(options.variants or experiment.variants),
        "seed": options.seed,
        **({"goals": options.goals} if experiment.counts_goals else {}),
        "max_seconds": options.max_seconds,
        **({"planned": len(cases), "finished": len(outcomes)} if len(outcomes) < len(cases) else {}),
        "date": time.strftime("%Y-%m-%d"),
        "machine": describe_machine(jobs),
        "failed": [{"case": case.key, "error": outcome["error"]} for case, outcome in outcomes.items() if "error" in outcome],
        "summary": summary,
    }


def _run_missing(
    pool: ProcessPoolExecutor, experiment: Experiment, files: dict[Case, Path], settings: CaseSettings, report: Progress, *, until: float
) -> None:
    """Run the cases of an experiment that have no file, in their order; none begins after `until` on the monotonic clock [s]."""
    missing = [case for case, file in files.items() if not file.exists()]
    n_before = len(files) - len(missing)
    # Where the time is up before the first one, what is finished is published.
    calls = [(_run_case, (experiment.run, case, settings, files[case])) for case in missing] if time.monotonic() < until else []
    report(experiment.name, n_before, len(files))
    run_calls(pool, calls, lambda done, first: report(experiment.name, n_before + done, len(files)), until=until)


def _no_result(experiment: Experiment, options: RunOptions, outcomes: Sequence[Json]) -> str:
    if not outcomes:
        return f"No case of {experiment.name} was finished in {options.stop_after:g} min; give it more time."
    return f"All {len(outcomes)} cases of {experiment.name} failed, the first with: {outcomes[0]['error']}"


def run_benchmark(benchmark: Benchmark, settings: Settings, on_progress: Progress | None = None) -> Json:
    """Measure every piece of a benchmark in a fresh process.

    Gives what the run was (`benchmark, seed, quick, date, machine`) and the benchmark's `summary`. Raises PushIdentError where a piece
    could not be measured.
    """
    report = on_progress or (lambda what, done, total: None)
    machine, pieces = describe_machine(1), benchmark.pieces(settings)
    labels = [*(f"{benchmark.name}: {piece.label}" for piece in pieces), benchmark.name]
    calls = [(piece.measure, piece.arguments) for piece in pieces]
    with single_threads(fresh=True) as pool:
        results = run_calls(pool, calls, lambda done, first: report(labels[first], done, len(pieces)))
    machine["load_after"] = describe_machine(1)["load"]
    summary = benchmark.summarise(results)
    what = {"benchmark": benchmark.name, "seed": settings.seed, "quick": settings.quick, "date": time.strftime("%Y-%m-%d")}
    return {**what, "machine": machine, "summary": summary}


def run_calls(pool: ProcessPoolExecutor, calls: _Calls, report: Callable[[int, int], None], *, until: float = math.inf) -> list[Any]:
    """Run the calls side by side; the results of all that began before `until` on the monotonic clock [s], in their order.

    `report` gets the number of finished calls and the index of the first one that is not, at the start and each time one finishes.
    """
    futures: list[Future[Any]] = [pool.submit(function, *arguments) for function, arguments in calls]
    pending = set(futures)
    while pending:
        report(len(futures) - len(pending), next(i for i, future in enumerate(futures) if future in pending))
        left = None if math.isinf(until) else max(until - time.monotonic(), 0.0)
        finished, pending = wait(pending, timeout=left, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
        if time.monotonic() >= until:
            pending = {future for future in pending if not future.cancel()}
            until = math.inf
    made = [future for future in futures if not future.cancelled()]
    if made:
        report(len(made), len(futures))
    return [future.result() for future in made]


def _models(experiment: Experiment, options: RunOptions) -> list[tuple[str, int]]:
    objects = _objects(experiment, options)
    return [(name, options.seed + i) for i in range(options.n_models) for name in objects]


def _objects(experiment: Experiment, options: RunOptions) -> tuple[str, ...]:
    """Those that are asked for, or all. Raises InputError for unknown ones."""
    known = experiment.find_objects(options.recordings) if experiment.find_objects else experiment.objects
    if unknown := [name for name in options.objects if name not in known]:
        raise InputError(f"Object {unknown[0]!r} is not known, expected some of {', '.join(known)}.")
    return options.objects or known


def cases_of(experiment: Experiment, options: RunOptions) -> list[Case]:
    """The cases that these options ask for, in the order in which they run. Raises InputError where they name what is not there."""
    if unknown := [v for v in options.variants if v not in experiment.variants]:
        raise InputError(f"Experiment {experiment.name} has no variant {unknown[0]!r}, expected some of {', '.join(experiment.variants)}.")
    models = _models(experiment, options)
    return [
        Case(name, model, variant)
        for name, model in models
        for variant in options.variants or experiment.variants
        if model - options.seed < experiment.most_models.get(variant, options.n_models)
        and (model - options.seed) % experiment.every.get(variant, 1) == 0
    ]


def _missing_truths(experiment: Experiment, options: RunOptions) -> _Calls:
    """Calls that simulate the ground-truth pushes that are not there."""
    return [
        (generate_truth, (options.truth_folder, name, model, options.truth))
        for name, model in _models(experiment, options)
        if not truth_file(options.truth_folder, name, model, options.truth).exists()
    ]


def _digest(experiment: Experiment, settings: CaseSettings) -> str:
    """Hash of everything except the case that a result depends on: the settings and the code, that of the ground truth included.

    The stages of the core count as a whole, since some of their modules are found by name.
    """
    values = [asdict(part) for part in (settings.budget, settings.truth, settings.noise)]
    if experiment.find_objects:
        values.append({"recordings": str(settings.recordings.resolve())})
    if experiment.counts_goals:
        values.append({"goals": settings.goals})
    own = Path(experiment.run.__code__.co_filename).relative_to(SIM)
    files = code_of(SIM, (*_OF_ALL, str(own if len(own.parts) == 2 else own.parent))) | code_of(
        CORE, ("types.py", "geometry", "physics", "pushing", *experiment.stages)
    )
    return hashlib.sha256(f"{json.dumps(values, sort_keys=True)} {code_digest(files)}".encode()).hexdigest()[:10]


def _run_case(run: Callable[[Case, CaseSettings], Json], case: Case, settings: CaseSettings, file: Path) -> None:
    """Run one case into its file. `run` is given itself: to find it by name, each process would have to load all studies."""
    try:
        outcome: Json = {"case": asdict(case), "values": run(case, settings)}
    except PushIdentError as error:
        outcome = {"case": asdict(case), "error": str(error)}
    write_json(file, outcome)
