"""One bag of a fleet: how it is found and how it is identified."""

from __future__ import annotations

import hashlib
import json
import os
import platform
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import push_ident
from push_ident.bags.opening import SUFFIXES
from push_ident.bags.read_options import ReadOptions
from push_ident.errors import InputError, PushIdentError
from push_ident.identification.fitting.budget import Budget
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.predicting.prediction import push_errors
from push_ident.identification.report.result_json import result_json
from push_ident.identification.results.model_file import model_content
from push_ident.identification.solvers import DEFAULT_SOLVER
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes

Outcome = dict[str, Any]
"""JSON of one bag: `bag`, `state` ("done" or "failed"), `error`, `host`, `process`, `seconds`, and if identified `result`, `model` and,
where asked for, `page`."""


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """Options of the identification of each bag."""

    prior: Prior = field(default_factory=Prior)
    method: str = DEFAULT_SOLVER
    object_id: str = ""
    """Object to identify; empty: in each bag the one with the most pushes."""
    held_out: int = 4
    """n: every nth push is held out as a test; 0: none."""
    max_seconds: float = 30.0
    """Time limit of one solve [s]."""
    seed: int = 0
    """Seed of methods that draw random numbers."""
    pages: bool = True
    """Whether each bag gets a page, which takes about a second of it."""
    reading: ReadOptions = field(default_factory=ReadOptions)
    """How each bag is read."""

    def __post_init__(self) -> None:
        if self.held_out < 0 or self.held_out == 1:
            raise InputError(f"Every {self.held_out}th push would be held out, expected 0 for none, or 2 and more.")


@dataclass(frozen=True, slots=True)
class Job:
    """One bag, and the name under which its result is stored."""

    bag: Path
    key: str
    """File name; it changes with the bag, its content on the disk, the options and the version."""


def find_jobs(paths: Sequence[Path], options: FleetOptions) -> list[Job]:
    """The bags under some paths, each once, sorted: bags, or folders that hold bags at any depth.

    Raises:
        InputError: a path does not exist, or holds no bag.
    """
    bags: dict[Path, None] = {}
    for path in paths:
        if not path.exists():
            raise InputError(f"{path} does not exist; name bags, or folders with bags in them.")
        in_path = list(_bags_in(path))
        if not in_path:
            raise InputError(f"There is no bag in {path}, expected files {', '.join(SUFFIXES)} or folders with metadata.yaml.")
        bags.update(dict.fromkeys(sorted(in_path)))
    text = json.dumps(asdict(options), sort_keys=True, default=str) + push_ident.__version__
    return [Job(bag, f"{bag.stem}-{_digest(bag, text)}") for bag in bags]


def identify_bag(bag: Path, options: FleetOptions) -> Outcome:
    """Identify one bag. A failure is an outcome with its error; nothing is raised except when the user stops the run."""
    started = time.monotonic()
    outcome: Outcome = {"bag": str(bag), "state": "failed", "error": "", "host": platform.node(), "process": os.getpid()}
    try:
        loaded = load_pushes([bag], object_id=options.object_id, options=options.reading, possible_with=options.prior)
        n, every = len(loaded.records), options.held_out
        train = [i for i in range(n) if not every or i % every != every - 1]
        budget = Budget(max_seconds=options.max_seconds)
        chosen = [loaded.records[i] for i in train]
        result = identify(chosen, options.prior, method=options.method, budget=budget, options=FitOptions(seed=options.seed))
        sources = [record.source for record in chosen]
        notes = [*loaded.notes, *result.explanation.notes(sources)]
        fitted = push_errors(result, loaded.records, train)
        held_out = push_errors(result, loaded.records, [i for i in range(n) if i not in train])
        outcome["result"] = result_json(result, loaded.object_id, fitted, held_out, notes)
        outcome["model"] = model_content(result.posterior, loaded.object_id, sources, result.status).model_dump_json(indent=1)
        if options.pages:
            from push_ident.identification.report import Provenance, report_text

            provenance = Provenance(loaded.object_id, tuple(sources), tuple(notes))
            outcome["page"] = report_text(result, fitted, held_out, provenance, loaded.records[0].pusher.radius)
        if result.status.is_failure:
            outcome["error"] = result.explanation.failure or result.status.value
        else:
            outcome["state"] = "done"
    except PushIdentError as error:
        outcome["error"] = str(error)
    except Exception as error:  # whatever is wrong with one bag must not stop the others
        outcome["error"] = f"{type(error).__name__}: {error}"
    outcome["seconds"] = round(time.monotonic() - started, 3)
    return outcome


def _bags_in(path: Path) -> Iterator[Path]:
    """The bags at a path or below it."""
    if path.is_file() or (path / "metadata.yaml").is_file() or (path / f"{path.name}.mcap").is_file():
        yield path
    else:
        for entry in sorted(path.iterdir()):
            if entry.is_dir():
                yield from _bags_in(entry)
            elif entry.suffix in SUFFIXES:
                yield entry


def _digest(bag: Path, options: str) -> str:
    """Hash of a bag (path, sizes and times of its files) and of the options."""
    parts = sorted(p for p in bag.iterdir() if p.is_file()) if bag.is_dir() else [bag]
    stats = [(p.name, p.stat().st_size, p.stat().st_mtime_ns) for p in parts]
    return hashlib.sha256(f"{bag.resolve()}{stats}{options}".encode()).hexdigest()[:12]
