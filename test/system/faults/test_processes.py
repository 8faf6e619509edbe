"""Faults of processes: killed, stopped, starved."""

from __future__ import annotations

import multiprocessing
import os
import random
import signal
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest
from system.faults.cell import BARE_CELL, IDENTIFICATION, Cell
from system.faults.monitor import until
from system.faults.oracles import learned_pushes
from system.faults.process import TRACEBACK, Process
from system.faults.suite import Trial, fault

from push_ident.cli.supervisor import NodeCommand, node_commands
from push_ident.nodes.base.network import own_domain
from push_ident.pushing.push import PushCode

CLI = (sys.executable, "-m", "push_ident.cli")
OF_A_MAP = ("mass", "friction", "mass_friction", "mass_friction_std")
N_MOMENTS = 100
LATEST = 3.0
"""A signal comes at a random moment up to this after the start of a node [s]."""
QUIET_END = 2.0
"""Longest time from a signal to the end of a node [s]."""
STALLED, REPEATED = 0.3, 5
"""A trial in which a node waits so long for a processor [s] is repeated, up to so many times."""
CGROUP = Path("/sys/fs/cgroup/memory/push_ident_faults")
SPARE = 2
"""What a node may allocate beyond what it has [MiB]."""


@fault(21, "SIGKILL to identification during a push, then started again", "resumes with an equal map; the executor does not notice")
def test_identification_killed(trial: Trial) -> None:
    cell = trial.cell
    cell.whole_push()
    trial.expect_learned()
    sent = cell.begin(cell.goal(-1))
    cell.processes[IDENTIFICATION].kill()
    time.sleep(0.2)  # for maps that were under way
    since = time.monotonic()
    trial.expect_code(cell.end(sent), PushCode.NONE)
    before = [msg for _, msg in cell.monitor.maps]
    cell.processes[IDENTIFICATION].start()
    until(lambda: cell.monitor.maps[-1][0] > since, 20.0, "no map came after the restart")
    after = next(msg for received, msg in cell.monitor.maps if received > since)
    equal = [all(np.array_equal(getattr(msg, name), getattr(after, name)) for name in OF_A_MAP) for msg in before]
    assert any(equal), "the map after the restart is none of those before"
    trial.note = f"{learned_pushes(cell)} pushes in the model, its map equal to the last bit"


@fault(
    59,
    f"Ctrl-C or SIGTERM at {N_MOMENTS} random moments of the first {LATEST:.0f} s of nodes",
    "exit 0 within 2 s, no traceback",
    cell=None,
)
def test_interrupt_any_moment(trial: Trial) -> None:
    commands, rng, domain = node_commands("sim"), random.Random(0), own_domain()
    plans = [
        (i, commands[i % len(commands)], rng.uniform(0.0, LATEST), rng.choice([signal.SIGINT, signal.SIGTERM])) for i in range(N_MOMENTS)
    ]

    def judged(plan: tuple[int, NodeCommand, float, signal.Signals]) -> End:
        # After 1.8 s a node ends itself by force: where it had to wait for a processor meanwhile, the trial shows nothing of it.
        for _ in range(REPEATED):
            end = interrupted(*plan, trial.folder, domain)
            if end.waited < STALLED:
                break
        return end

    with ThreadPoolExecutor(max(1, (os.cpu_count() or 1) // 2)) as pool:  # the others load meanwhile
        ends = list(pool.map(judged, plans))
    for end in ends:
        assert not end.traceback, f"{end.name}: a traceback"
        assert end.code == 0 or end.waited >= STALLED, f"{end.name}: exit code {end.code}, expected 0"
        assert end.took - end.waited < QUIET_END, f"{end.name}: it ended after {end.took:.1f} s"
    stalled = sum(end.waited >= STALLED for end in ends)
    trial.note = (
        f"{len(ends)} starts; the slowest ended after {max(end.took for end in ends):.1f} s; {stalled} waited for a processor each time"
    )
    assert stalled < 0.1 * N_MOMENTS, f"in {stalled} of {N_MOMENTS} trials the machine stalled each time: nothing is shown"


@dataclass(frozen=True)
class End:
    name: str
    code: int | None
    took: float
    """[s]"""
    waited: float
    """Of that, the longest time for which one of its threads was ready to run and had no processor [s]."""
    traceback: bool


def interrupted(number: int, command: NodeCommand, delay: float, how: signal.Signals, folder: Path, domain: int) -> End:
    process = Process(command, folder / f"{number}-{command.name}.log", domain)
    time.sleep(delay)
    before, asked, code, waited = waits(process.pid), process.signal(how), None, 0.0
    while code is None and time.monotonic() < asked + 10.0:
        waited = max([waited, *(wait - before.get(thread, 0.0) for thread, wait in waits(process.pid).items())])
        code = process.wait(0.05)
    took = time.monotonic() - asked
    process.kill()
    return End(f"{command.name}, {how.name} after {delay:.2f} s", code, took, waited, TRACEBACK in process.output)


def waits(pid: int) -> dict[str, float]:
    """How long each thread of a process has been ready to run without a processor [s]; none where the system does not say."""
    found = {}
    for path in Path(f"/proc/{pid}/task").glob("*/schedstat"):
        with suppress(OSError):
            found[path.parent.name] = 1e-9 * int(path.read_text().split()[1])
    return found


@fault(30, "SIGKILL to `push-ident up arm` during a push", "the arm stands; all children end within 3 s", cell=BARE_CELL, within=0.5)
def test_supervisor_killed(trial: Trial) -> None:
    cell = trial.cell
    up = cell.add(NodeCommand("up", (*CLI, "up", "arm")))
    try:
        until(lambda: plans_a_push(cell), 60.0, "no push can be planned")
        cell.begin()
        children = psutil.Process(up.pid).children(recursive=True)
        os.kill(up.pid, signal.SIGKILL)
        trial.expect_hold(time.monotonic())
        _, alive = psutil.wait_procs(children, timeout=3.0)
        assert not alive, f"{len(alive)} of {len(children)} children go on"
    finally:
        cell.processes.pop("up").kill()


def plans_a_push(cell: Cell) -> bool:
    goal = cell.goal()
    goal.dry_run = True
    return cell.push(goal).error_code == PushCode.NONE


def spin_forever() -> None:
    while True:
        pass


@fault(50, "two busy processes for each core during a push", "made, or aborted and held")
def test_processor_taken(trial: Trial) -> None:
    cell = trial.cell
    # `fork`: these processes import nothing.
    hogs = [multiprocessing.get_context("fork").Process(target=spin_forever, daemon=True) for _ in range(2 * (os.cpu_count() or 1))]
    for hog in hogs:
        hog.start()
    try:
        result = cell.push()
    finally:
        for hog in hogs:
            hog.kill()
    time.sleep(0.5)
    assert not cell.is_moving(), "the arm still moves"
    trial.expect_code(result, PushCode.NONE, PushCode.ARM_SILENT, PushCode.TRACKING, PushCode.OBJECT_LOST, PushCode.FORCE)


@fault(
    51,
    "identification may not allocate memory during a push; the kernel ends it",
    "made, or aborted and held; nothing that was acknowledged is lost",
)
def test_memory_taken(trial: Trial) -> None:
    cell = trial.cell
    try:
        CGROUP.mkdir(exist_ok=True)
    except OSError as error:
        pytest.skip(f"a limit of memory needs a writable {CGROUP.parent}: {error.strerror}")
    process = cell.processes[IDENTIFICATION]
    cell.whole_push()
    trial.expect_learned()
    sent = cell.begin(cell.goal(-1))
    (CGROUP / "cgroup.procs").write_text(str(process.pid))
    (CGROUP / "memory.limit_in_bytes").write_text(f"{SPARE}M")
    result = cell.end(sent)
    trial.expect_code(result, PushCode.NONE, PushCode.ARM_SILENT, PushCode.TRACKING)  # the kernel's search for memory stalls the machine
    time.sleep(1.0)
    process.kill()
    time.sleep(0.2)
    CGROUP.rmdir()
    process.start()
    until(lambda: learned_pushes(cell) is not None, 30.0, "identification does not come back")
