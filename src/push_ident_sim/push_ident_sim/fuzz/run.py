"""Fuzz the nodes of the suite, two at a time, each in a process with a ROS domain of its own; findings minimised and stored."""

from __future__ import annotations

import json
import multiprocessing
import os
import shutil
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from push_ident.errors import InputError
from push_ident.files import write_whole
from push_ident.nodes.executables import NODES
from push_ident_sim.executables import NODES as SIM_NODES

__all__ = ["FUZZED", "Settings", "fuzz_messages", "nodes_of"]

FUZZED: Final = (*NODES, *SIM_NODES)
"""Every executable of both packages."""
_JOBS: Final = 2
_MINIMISE: Final = (60.0, 120.0)
"""A search for the messages that cause a failure has the time left for the node, but at least and at most this [s]."""
_RESTARTS: Final = 6
"""A node that failed so often is left alone."""
_PROGRESS: Final = "progress.json"


@dataclass(frozen=True, slots=True)
class Settings:
    """What is fuzzed, and for how long."""

    minutes: float = 12.0
    """For all nodes together."""
    seed: int = 0
    nodes: tuple[str, ...] = FUZZED
    out: Path = Path("out/fuzz")
    cases: Path | None = None
    """Folder of minimised failures; they are written there, and those that are there are sent first."""
    messages: int | None = None
    """Mutated messages for each node, where that ends before the time."""
    jobs: int = _JOBS
    domains: tuple[int, ...] = ()
    """ROS domains, one a job; none: ROS_DOMAIN_ID and the next, or some of their own."""


def fuzz_messages(settings: Settings, on_progress: Callable[[str], None] = lambda line: None) -> dict[str, Any]:
    """Results of all nodes: `seed, minutes, mutated, findings, nodes`."""
    began = time.monotonic()
    share = 60.0 * settings.minutes * settings.jobs / max(len(settings.nodes), settings.jobs)
    shutil.rmtree(settings.out, ignore_errors=True)
    results, findings = [], []
    with ProcessPoolExecutor(settings.jobs, mp_context=multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        left, free = list(settings.nodes), list(range(settings.jobs))
        running: dict[Future[Any], tuple[str, int]] = {}
        while left or running:
            while left and free:
                node, slot = left.pop(0), free.pop(0)
                running[pool.submit(_fuzz_node, node, settings, share, slot)] = (node, slot)
            done = [future for future in running if future.done()]
            for future in done:
                free.append(running.pop(future)[1])
                content = future.result()
                results.append(content["result"])
                findings += content["findings"]
                on_progress(_line(content["result"], finished=True))
            if not done:
                _wait([node for node, _ in running.values()], settings, on_progress)
    return {
        "seed": settings.seed,
        "minutes": round((time.monotonic() - began) / 60.0, 2),
        "load": round(os.getloadavg()[0], 1),
        "mutated": sum(result["mutated"] for result in results),
        "findings": findings,
        "nodes": sorted(results, key=lambda result: str(result["node"])),
    }


def _wait(nodes: Sequence[str], settings: Settings, on_progress: Callable[[str], None]) -> None:
    time.sleep(0.5)
    for node in nodes:
        path = settings.out / node / _PROGRESS
        if path.exists():
            on_progress(_line(json.loads(path.read_text(encoding="utf-8")), finished=False))
            path.unlink()


def _line(result: dict[str, Any], *, finished: bool) -> str:
    failed = ", ".join(failure["kind"] for failure in result["failures"]) or "none failed"
    return (
        f"{result['node']}: {result['mutated']} mutated, {result['valid']} valid, {result['works']} times worked, "
        f"answer within {1e3 * result['worst_answer']:.0f} ms, {result['memory_growth']:+.0f} MB, {failed}{'; done' if finished else ''}"
    )


def _fuzz_node(node: str, settings: Settings, seconds: float, slot: int) -> dict[str, Any]:
    """Result and findings of one node; runs in a process of its own."""
    # Imported here: the parent process needs no ROS.
    from push_ident_sim.fuzz.cases import read_cases, write_case
    from push_ident_sim.fuzz.minimise import minimise
    from push_ident_sim.fuzz.session import NodeResult, Session, merged

    own = int(os.environ.get("ROS_DOMAIN_ID", "0")) or os.getppid() % 50 + 1
    domain = settings.domains[slot] if settings.domains else own + slot
    folder = (settings.out / node).absolute()
    first = read_cases(settings.cases).get(node, []) if settings.cases is not None else []
    until, results, findings = time.monotonic() + seconds, list[NodeResult](), list[dict[str, Any]]()

    def progress(result: NodeResult) -> None:
        write_whole(folder / _PROGRESS, json.dumps(merged([*results, result]).as_dict()), "the progress", durable=False)

    for run in range(_RESTARTS):
        session = Session(node, folder / f"run{run}", domain, settings.seed + 1000 * run)
        folder.mkdir(parents=True, exist_ok=True)
        finding = session.run(until=until, n_messages=settings.messages, first=first, on_progress=progress)
        results.append(session.result)
        first = []
        if finding is None:
            break
        patience = min(max(until - time.monotonic(), _MINIMISE[0]), _MINIMISE[1])
        messages = minimise(finding, folder / f"minimise{run}", domain, seconds=patience)
        path = (settings.cases or settings.out) / f"{node}_{finding.kind.replace(' ', '_')}_{settings.seed}_{run}.json"
        write_case(path, finding, messages or finding.messages[-100:])
        findings.append({"node": node, "kind": finding.kind, "text": finding.text, "messages": len(messages), "file": str(path)})
        if time.monotonic() > until:
            break
    return {"result": merged(results).as_dict(), "findings": findings}


def nodes_of(names: Sequence[str]) -> tuple[str, ...]:
    """The executables of these names, all for none. Raises InputError for an unknown one."""
    unknown = [name for name in names if name not in FUZZED]
    if unknown:
        raise InputError(f"There is no node {unknown[0]!r}, expected one of {', '.join(FUZZED)}.")
    return tuple(names) or FUZZED
