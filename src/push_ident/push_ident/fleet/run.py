"""Distribute the bags to Ray's workers, store each outcome as it arrives, continue an interrupted run."""

from __future__ import annotations

import json
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from push_ident.errors import InputError, PushIdentError
from push_ident.extras import need
from push_ident.files import json_text, write_whole
from push_ident.fleet.job import FleetOptions, Job, Outcome, identify_bag


def run_fleet(
    jobs: Sequence[Job],
    options: FleetOptions,
    folder: Path,
    *,
    address: str = "",
    workers: int = 0,
    again: bool = False,
    on_outcome: Callable[[Outcome], None] | None = None,
) -> list[Outcome]:
    """Identify all bags that have no outcome in `folder` yet.

    Args:
        jobs: from `find_jobs`. With several machines, the bags have the same paths on all of them.
        options: options of the identification.
        folder: folder of the outcomes, one file per bag in `folder`/bags; models are in `folder`/models, pages in `folder`/pages.
        address: address of a Ray cluster (`auto`, `ray://host:10001`); empty starts one on this machine.
        workers: processes on this machine; 0: one per core. Ignored with `address`: there all processors of the cluster work.
        again: whether bags that failed in an earlier run are tried again.
        on_outcome: called with each outcome, those of an earlier run included.

    Returns:
        Outcomes in the order of the jobs.

    Raises:
        InputError: The cluster cannot be reached.
        MissingPackageError: Ray is not installed.
        PushIdentError: `folder` cannot be written.
    """
    show = on_outcome or (lambda outcome: None)
    outcomes: dict[str, Outcome] = {}
    todo: list[Job] = []
    for job in jobs:
        known = _read(folder, job)
        if known is not None and not (again and known["state"] == "failed"):
            outcomes[job.key] = known
            show(known)
        else:
            todo.append(job)
    if todo:
        with TemporaryDirectory(prefix="push_ident_ray_", ignore_cleanup_errors=True) as scratch:
            ray = _start(address, workers, scratch)
            try:
                for job, outcome in _run_all(ray, todo, options):
                    _store(folder, job, outcome)
                    outcomes[job.key] = outcome
                    show(outcome)
            finally:
                ray.shutdown()
    return [outcomes[job.key] for job in jobs]


def _run_all(ray: Any, todo: Sequence[Job], options: FleetOptions) -> Iterator[tuple[Job, Outcome]]:
    """Jobs and their outcomes, as they are done."""
    remote = ray.remote(num_cpus=1, max_retries=1)(identify_bag)
    waiting = list(reversed(todo))
    under_way: dict[Any, Job] = {}
    # Three bags queued per worker, so that none waits for the next one.
    limit = 3 * max(1, int(ray.cluster_resources().get("CPU", 1)))
    while waiting or under_way:
        while waiting and len(under_way) < limit:
            job = waiting.pop()
            under_way[remote.remote(job.bag.resolve(), options)] = job
        finished, _ = ray.wait(list(under_way), num_returns=1)
        for reference in finished:
            job = under_way.pop(reference)
            try:
                outcome = ray.get(reference)
            except ray.exceptions.RayError as error:
                # The worker was killed, ran out of memory, or its machine was lost; the first line names the cause.
                lines = str(error).strip().splitlines() or [""]
                why = f"its worker died twice ({type(error).__name__}: {lines[0]}); check the memory of the machine"
                outcome = {"bag": str(job.bag), "state": "failed", "error": why, "host": "", "process": 0, "seconds": 0.0}
            outcome["bag"] = str(job.bag)
            yield job, outcome


def _start(address: str, workers: int, scratch: str) -> Any:
    """Connect to a cluster or start one, with its sockets and logs in the folder `scratch`; the module `ray`."""
    # Ray reads these when it is imported.
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    need("fleet")
    import ray

    # One thread per bag, since the bags run in parallel.
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")}
    here: dict[str, Any] = {}
    if not address:
        # The switch of Ray for clusters on Windows and macOS; off, its servers stay on 127.0.0.1 here, too, instead of an address of the
        # network. Its folder has a random name and is for this user only.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        here = {
            "num_cpus": workers or os.cpu_count() or 1,
            "include_dashboard": False,
            "_node_ip_address": "127.0.0.1",
            "_temp_dir": scratch,
        }
    try:
        ray.init(address=address or "local", runtime_env={"env_vars": threads}, logging_level=logging.ERROR, log_to_driver=False, **here)
    except Exception as error:  # what Ray raises where its node is not up within 30 s
        ray.shutdown()  # a later start would wait for what is left of this one
        line = (str(error).strip().splitlines() or ["no reason given"])[0]
        raise InputError(f"Ray does not start at {address or 'this machine'}: {line}; start a cluster with `ray start --head`.") from None
    return ray


def _file(folder: Path, job: Job) -> Path:
    return folder / "bags" / f"{job.key}.json"


def _read(folder: Path, job: Job) -> Outcome | None:
    """Stored outcome of a job; None without one."""
    try:
        content: Outcome = json.loads(_file(folder, job).read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise PushIdentError(f"{_file(folder, job)} cannot be read: {error}; remove it to identify the bag again.") from None
    return content


def _store(folder: Path, job: Job, outcome: Outcome) -> None:
    """Write model and page, then the outcome: a stored outcome implies that these are complete."""
    for kind, ending, name in (("model", "json", "the model"), ("page", "html", "the page")):
        content = outcome.pop(kind, None)
        if content is not None:
            path = folder / f"{kind}s" / f"{job.key}.{ending}"
            write_whole(path, content, name, private=kind == "model")
            outcome[f"{kind}_file"] = str(path.relative_to(folder))
    write_whole(_file(folder, job), json_text(outcome), "the outcome of a bag")
