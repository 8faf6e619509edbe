"""Commands on one bag, each in a forked process whose time, memory, output and result are watched.

Starting Python and importing the package takes longer than most mutated bags: a server imports once and forks for each run. It
runs nothing itself, so that no thread of a library exists when it forks.
"""

from __future__ import annotations

import json
import math
import os
import resource
import signal
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

__all__ = ["COMMANDS", "Run", "commands_for", "judge", "run_forked"]

MAX_SECONDS: Final = 10.0
"""Longest time of the processor that a command may take on a bag of at most 100 MB [s]."""
MAX_MEMORY: Final = 1_000_000
"""Largest resident memory [kB]."""
_PATIENCE: Final = 300.0
"""Time of the clock after which a run is killed: one that waits for ever [s]. Far longer, as others may share the machine."""
_ADDRESS_SPACE: Final = 8 << 30
"""So much a run can take before it fails, so that the machine survives [bytes]."""
_MAX_TRAINING_ERROR: Final = 0.05
"""A converged fit that misses its own training pushes by more explains nothing [m]."""
_REFUSED: Final = (1, 2)


@dataclass(frozen=True, slots=True)
class Run:
    """What one command did."""

    command: str
    exit_code: int
    """Negative: ended by that signal."""
    wall: float
    """[s]"""
    cpu: float
    """[s]"""
    memory: int
    """Largest resident memory [kB]."""
    output: str
    result: dict[str, Any] | None
    """The JSON that the command wrote."""


def _cli(*arguments: str) -> None:
    from push_ident.cli.main import main

    sys.argv = ["push-ident", *arguments]
    main()


def _fleet(bag: Path, out: Path) -> None:
    from push_ident.cli.output import write_json
    from push_ident.fleet.job import FleetOptions, find_jobs, identify_bag

    jobs = find_jobs([bag], FleetOptions())
    outcomes = [identify_bag(job.bag, FleetOptions()) for job in jobs]
    write_json(out / "result.json", outcomes[0] if outcomes else {})
    if any(outcome["state"] != "done" for outcome in outcomes) or not outcomes:
        print(f"push-ident: {outcomes[0]['error'] if outcomes else 'no bag'}", file=sys.stderr)
        sys.exit(1)


def _play(bag: Path, out: Path) -> None:
    del out
    from push_ident.nodes.base.network import own_domain

    os.environ["ROS_DOMAIN_ID"] = str(own_domain())
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "OFF"
    from push_ident.nodes.recording.bag_player_node import main

    sys.argv = ["bag_player_node", "--ros-args", "-p", f"bag:={bag}", "-p", "rate:=0.0", "-p", "wait:=0.0", "-p", "listeners:=0"]
    sys.exit(main())


COMMANDS: Final[dict[str, Callable[[Path, Path, Path], None]]] = {
    "identify": lambda bag, out, model: _cli("identify", str(bag), "--json", str(out / "result.json")),
    "diagnose": lambda bag, out, model: _cli("diagnose", str(bag), "--json", str(out / "result.json")),
    "predict": lambda bag, out, model: _cli("predict", str(model), str(bag), "--json", str(out / "result.json")),
    "salvage": lambda bag, out, model: _cli("salvage", str(bag), "--out", str(out / "salvaged")),
    "fleet": lambda bag, out, model: _fleet(bag, out),
    "play": lambda bag, out, model: _play(bag, out),
    "import cmu-mocap": lambda bag, out, model: _cli(
        "import", "cmu-mocap", str(bag), "--out", str(out / "bag"), "--json", str(out / "result.json")
    ),
    "import cmu-icra16": lambda bag, out, model: _cli(
        "import", "cmu-icra16", str(bag), "--out", str(out / "bag"), "--json", str(out / "result.json")
    ),
}
"""Name -> what it does with a bag, a new folder, and the model of the unchanged bag."""


def commands_for(source: str, number: int) -> list[str]:
    """Commands that read a mutant of this source; the slow ones read a part of the mutants only."""
    if source == "icra16":
        return ["import cmu-icra16"]
    if source == "mocap":
        return ["import cmu-mocap"]
    chosen = ["identify", "predict"]
    if source != "rosbag1":
        chosen += ["salvage"]
    return [
        *chosen,
        *(["diagnose"] if number % 2 == 0 else []),
        *(["fleet"] if number % 5 == 1 else []),
        *(["play"] if number % 10 == 3 else []),
    ]


def run_forked(command: str, bag: Path, out: Path, model: Path) -> Run:
    """Run one command in a fork of this process."""
    out.mkdir(parents=True)
    began = time.monotonic()
    child = os.fork()
    if child == 0:
        _become(command, bag, out, model)
    status, usage = _awaited(child, began + _PATIENCE)
    text = (out / "output").read_text(errors="replace") if (out / "output").exists() else ""
    return Run(
        command,
        os.waitstatus_to_exitcode(status),
        time.monotonic() - began,
        usage.ru_utime + usage.ru_stime,
        usage.ru_maxrss,
        text[-20_000:],
        _result(out / "result.json"),
    )


def _become(command: str, bag: Path, out: Path, model: Path) -> None:
    """The child: never returns."""
    code = 70
    try:
        log = os.open(out / "output", os.O_WRONLY | os.O_CREAT)
        os.dup2(log, 1)
        os.dup2(log, 2)
        os.chdir(out)
        resource.setrlimit(resource.RLIMIT_AS, (_ADDRESS_SPACE, _ADDRESS_SPACE))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        try:
            COMMANDS[command](bag, out, model)
            code = 0
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        import traceback

        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def _awaited(child: int, deadline: float) -> tuple[int, resource.struct_rusage]:
    while True:
        pid, status, usage = os.wait4(child, os.WNOHANG)
        if pid:
            return status, usage
        if time.monotonic() > deadline:
            os.kill(child, signal.SIGKILL)
            _, status, usage = os.wait4(child, 0)
            return status, usage
        time.sleep(0.01)


def _result(path: Path) -> dict[str, Any] | None:
    if not path.exists():
        return None
    content = json.loads(path.read_text())
    return content if isinstance(content, dict) else None


def judge(run: Run, out: Path) -> str:
    """The failure of a run; empty where it did what it should: a plausible result, or a refusal of a few lines."""
    if run.cpu > MAX_SECONDS or run.wall > _PATIENCE:
        return f"hang: {run.cpu:.0f} s of the processor, {run.wall:.0f} s"
    if run.memory > MAX_MEMORY:
        return f"memory: {run.memory / 1e6:.2f} GB"
    if "Traceback (most recent call last)" in run.output:
        return f"traceback: {run.output.strip().splitlines()[-1][:200]}"
    if run.exit_code not in (0, *_REFUSED):
        return f"ended with {run.exit_code}"
    if run.exit_code:
        return "" if _is_explained(run) else "refused without a reason"
    return _implausible(run, out)


def _is_explained(run: Run) -> bool:
    lines = run.output.strip().splitlines()
    return any("push-ident" in line or "[FATAL]" in line or "Error" in line for line in lines)


def _implausible(run: Run, out: Path) -> str:
    """Why the result of a successful command is wrong."""
    if run.command == "salvage":
        return _unreadable(out / "salvaged")
    if run.command == "play":
        return ""
    if run.result is None:
        return "wrong success: no result"
    if run.command.startswith("import"):
        return _unreadable(out / "bag") or _bad_number(run.result)
    if run.command == "diagnose":
        return _bad_number(run.result)
    result = run.result.get("result", run.result) if run.command == "fleet" else run.result
    return _bad_number(result) or _bad_maps(result)


def _bad_maps(result: dict[str, Any]) -> str:
    maps = result.get("map")
    cells = maps if isinstance(maps, dict) else {}
    for name in ("mass", "friction", "mass_friction"):
        if any(not value >= 0 for value in cells.get(name, ())):
            return f"wrong success: {name} of a cell is negative"
    error = (result.get("train") or {}).get("identified_m")
    if result.get("status") == "converged" and not (isinstance(error, float) and error <= _MAX_TRAINING_ERROR):
        return f"wrong success: converged with a training error of {error} m"
    return ""


def _bad_number(node: Any, where: str = "") -> str:
    """Where a result has a number that is not finite."""
    if isinstance(node, float) and not math.isfinite(node):
        return f"wrong success: {where or 'a number'} is {node}"
    items = node.items() if isinstance(node, dict) else enumerate(node) if isinstance(node, list) else ()
    return next((found for key, value in items if (found := _bad_number(value, f"{where}.{key}".strip(".")))), "")


def _unreadable(bag: Path) -> str:
    from push_ident.bags.opening import open_bag
    from push_ident.errors import PushIdentError

    try:
        with open_bag(bag) as opened:
            return "" if sum(1 for _ in opened.raw_messages()) else f"wrong success: {bag.name} has no message"
    except PushIdentError as error:
        return f"wrong success: {str(error)[:150]}"
