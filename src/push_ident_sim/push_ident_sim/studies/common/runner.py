"""Run the cases of an experiment side by side; each leaves a file, so that a run that was cut off goes on where it stopped."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import push_ident
from push_ident.errors import InputError, PushIdentError
from push_ident.identification.budget import Budget
from push_ident_sim.code_digest import code_digest, files_behind
from push_ident_sim.objects import OBJECT_NAMES
from push_ident_sim.recordings.truth import CameraNoise, TruthSettings, generate_truth, truth_file
from push_ident_sim.studies.common.experiment import Case, CaseResult, CaseSettings, Experiment, Json
from push_ident_sim.workers import describe_machine, single_threads

__all__ = ["RunOptions", "run_experiment", "write_json"]

Progress = Callable[[str, int, int], None]
"""Told what is under way, and how many of how many are done."""

_CORE = Path(push_ident.__file__).parent
_OF_SUMMARIES = ("push_ident_sim.studies.common.drawing",)
"""Modules that make nothing of a result but what is shown of it."""
_Calls = list[tuple[Callable[..., Any], tuple[Any, ...]]]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """Which cases to run, and where."""

    folder: Path
    """Of results: one file a case in FOLDER/NAME/."""
    truth_folder: Path
    """Of ground-truth pushes; they are simulated when they are not there."""
    objects: tuple[str, ...] = OBJECT_NAMES
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
    """Of recorded scenes, for the experiments that use them."""

    def __post_init__(self) -> None:
        if unknown := [name for name in self.objects if name not in OBJECT_NAMES]:
            raise InputError(f"Object {unknown[0]!r} is not known, expected some of {', '.join(OBJECT_NAMES)}.")
        for name, lowest in (("n_models", 1), ("jobs", 1), ("seed", 0)):
            if getattr(self, name) < lowest:
                raise InputError(f"`{name}` is {getattr(self, name)}, expected at least {lowest}.")


def run_experiment(experiment: Experiment, options: RunOptions, on_progress: Progress | None = None) -> Json:
    """Run every case that has no result yet, and sum up all of them.

    Returns:
        What the run was (`experiment, objects, models, seed, max_seconds, machine`), the cases that failed (`failed`: case and error),
        and the experiment's `summary`. Times are of the processor of the machine that ran the case.

    Raises:
        InputError: no case gave a result, or a variant that the experiment does not have.
    """
    report = on_progress or (lambda what, done, total: None)
    if unknown := [v for v in options.variants if v not in experiment.variants]:
        raise InputError(f"Experiment {experiment.name} has no variant {unknown[0]!r}, expected some of {', '.join(experiment.variants)}.")
    models = [(name, options.seed + i) for i in range(options.n_models) for name in options.objects]
    cases = [
        Case(name, model, variant)
        for name, model in models
        for variant in options.variants or experiment.variants
        if (variant not in experiment.once or (name, model) == models[0])
        and model - options.seed < experiment.fewer.get(variant, options.n_models)
    ]
    settings = CaseSettings(
        options.truth_folder, Budget(max_seconds=options.max_seconds, processor_time=True), options.truth, options.noise, options.recordings
    )
    folder = options.folder / experiment.name
    # Results of other settings or other code have other names, so that no mean is taken over both.
    digest = _digest(experiment, settings)
    files = {case: folder / f"{case.key}-{digest}.json" for case in cases}
    sealed = experiment.prepare(cases, folder) if experiment.prepare else None
    missing = [case for case in cases if not files[case].exists()]
    jobs = 1 if experiment.one_at_a_time else options.jobs
    with single_threads(jobs) as pool:
        unmade = [
            (n, m) for n, m in models if experiment.needs_truth and not truth_file(options.truth_folder, n, m, options.truth).exists()
        ]
        calls: _Calls = [(generate_truth, (options.truth_folder, n, m, options.truth)) for n, m in unmade]
        for done in _finished(pool, calls):
            report("simulating pushes", done, len(calls))
        calls = [(_run_case, (experiment.name, case, settings, files[case])) for case in missing]
        report(experiment.name, len(cases) - len(missing), len(cases))
        for done in _finished(pool, calls):
            report(experiment.name, len(cases) - len(missing) + done, len(cases))
    outcomes = {case: _read_json(files[case]) for case in cases}
    results = [CaseResult(case, outcome["values"]) for case, outcome in outcomes.items() if "values" in outcome]
    if not results:
        first = next(iter(outcomes.values()))["error"]
        raise InputError(f"All {len(cases)} cases of {experiment.name} failed, the first with: {first}")
    return {
        "experiment": experiment.name,
        "objects": list(options.objects),
        "models": options.n_models,
        "seed": options.seed,
        "max_seconds": options.max_seconds,
        "machine": describe_machine(jobs),
        "failed": [{"case": case.key, "error": outcome["error"]} for case, outcome in outcomes.items() if "error" in outcome],
        "summary": {**experiment.summarise(results), **({} if sealed is None else {"sealed": sealed})},
    }


def _digest(experiment: Experiment, settings: CaseSettings) -> str:
    """Of all that a result depends on but its case: the settings, and the code, also that which makes the ground truth.

    The stages of the core count whole, since some of their modules are found by name.
    """
    values = [asdict(part) for part in (settings.budget, settings.truth, settings.noise)]
    if experiment.once:
        values.append({"recordings": str(settings.recordings.resolve())})
    files = files_behind(Path(experiment.run.__code__.co_filename), _OF_SUMMARIES)
    files |= {path for stage in experiment.stages for path in (_CORE / stage).rglob("*.py")}
    return hashlib.sha256(f"{json.dumps(values, sort_keys=True)} {code_digest(files)}".encode()).hexdigest()[:10]


def _run_case(name: str, case: Case, settings: CaseSettings, file: Path) -> None:
    from push_ident_sim.studies import EXPERIMENTS

    try:
        outcome: Json = {"case": asdict(case), "values": EXPERIMENTS[name].run(case, settings)}
    except PushIdentError as error:
        outcome = {"case": asdict(case), "error": str(error)}
    write_json(file, outcome)


def _finished(pool: ProcessPoolExecutor, calls: _Calls) -> Iterator[int]:
    """Run the calls; yields how many are done, each time one more is."""
    pending: set[Future[Any]] = {pool.submit(function, *arguments) for function, arguments in calls}
    count = 0
    while pending:
        finished, pending = wait(pending, return_when=FIRST_COMPLETED)
        for future in finished:
            future.result()
            count += 1
            yield count


def write_json(path: Path, content: Json) -> None:
    """Write whole or not at all. Raises PushIdentError where it cannot be written, ValueError for numbers that are not finite."""
    partial = path.with_suffix(f".{os.getpid()}.partial")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        partial.write_text(json.dumps(content, separators=(",", ":"), allow_nan=False) + "\n", encoding="utf-8")
        partial.replace(path)
    except OSError as error:
        raise PushIdentError(f"Cannot write {path}: {error.strerror}; choose a place that can be written to.") from None


def _read_json(path: Path) -> Json:
    try:
        content: Json = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"Cannot read the result {path}: {error}; delete it and run the experiment again.") from None
    return content
