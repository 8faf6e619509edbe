"""What the command line says of fixed bags, stored as JSON, so that a redesign can be held against the code before it.

    python tools/baseline.py record OUT [--bags DIR] [--data DIR] [--only WORD]   run every case, one JSON file each
    python tools/baseline.py compare BEFORE AFTER                                 exit status 1 where a number or a name differs

Everything goes through `push-ident`, so the same script runs on both sides of a redesign. Simulated bags are made once in --bags and
used as they are from then on. Numbers must be equal to the last bit on one machine; sentences are prose and are not compared.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parent.parent
CLI = ROOT / ".venv" / "bin" / "push-ident"

PROSE = frozenset({"sentence", "check", "found", "remedy", "notes", "status_text", "source", "error"})
"""Keys of texts for people."""
CLOCK = frozenset({"time_s", "counts", "thresholds_sha256", "policy_sha256", "code_sha256", "machine"})
"""Keys that depend on the clock, or name the code itself."""

SIMULATED: dict[str, tuple[str, ...]] = {
    "null": ("--object", "wrench", "--seed", "3"),
    "tilt": ("--effect", "table_tilt=0.03,0.01", "--seed", "4"),
    "lag-and-anisotropy": ("--object", "crimp", "--effect", "pusher_lag=0.06", "--effect", "table_anisotropy=0.25,0.1", "--seed", "5"),
    "offset": ("--object", "book", "--effect", "tool_offset=0.003,-0.002", "--seed", "6"),
    "small-latency": ("--effect", "pose_latency=0.0015", "--position-noise", "0.00005", "--yaw-noise", "0.0005", "--seed", "7"),
    "height": ("--object", "toolbox", "--effect", "push_height=0.015318128510417509", "--seed", "8"),
    "contents": ("--object", "toolbox", "--effect", "moving_contents=0.03", "--seed", "9"),
    "outside-film": ("--object", "wrench", "--effect", "viscous_film=2.0", "--seed", "10"),
    "outside-wobble": ("--object", "hammer", "--effect", "pusher_wobble=0.003", "--seed", "11"),
    "flips": ("--effect", "pose_flips=0.1", "--seed", "12"),
    "camera-null": ("--camera", "--pushes", "6", "--seed", "13"),
    "camera-rotated": ("--camera", "--object", "book", "--pushes", "8", "--effect", "camera_rotation=0.06", "--seed", "14"),
}
"""Bags of `push-ident simulate`: each verdict and each kind of effect once."""
METHODS = {
    "gauss_newton": 4000,
    "fast_gradient": 80,
    "autograd": 12,
    "finite_differences": 300,
    "random_search": 60,
    "weighted_sampling": 60,
}
"""Solvers, each with the simulations that it may make: no clock decides a case."""


@dataclass(frozen=True)
class Case:
    """One command, and the file in which it leaves its JSON."""

    name: str
    arguments: tuple[str, ...]


def cases(bags: Path, data: Path) -> Iterator[Case]:
    """All cases, those on the files of other people where `data` holds them."""
    own = ROOT / "bags" / "hammer_depth"
    found = {"hammer_depth": own, **{name: bags / name for name in SIMULATED}}
    recorded = {
        "contract_sample": data / "contract_sample" / "bag",
        "cmu_icra16": bags / "cmu_icra16",
        "cmu_mocap": bags / "cmu_mocap",
    }
    found.update({name: path for name, path in recorded.items() if path.exists()})
    for name, bag in found.items():
        yield Case(f"identify-{name}", ("identify", str(bag), "--train", "0,1,2", "--max-seconds", "1e6"))
        yield Case(f"predict-{name}", ("predict", f"{{identify-{name}}}/model.json", str(bag)))
    for name in ("contract_sample", "tilt"):
        if name in found:
            for method, limit in METHODS.items():
                budget = ("--max-simulations", str(limit), "--max-seconds", "1e6")
                yield Case(f"solver-{method}-{name}", ("identify", str(found[name]), "--train", "0,1,2", "--method", method, *budget))
    for name, bag in found.items():
        yield Case(f"diagnose-{name}", ("diagnose", str(bag)))
    yield Case("diagnose-tilt-with", ("diagnose", str(found["tilt"]), "--with", "table_tilt"))
    if "contract_sample" in found:
        yield Case("replay-contract_sample", ("replay", str(found["contract_sample"]), "--rate", "2"))
    yield Case("replay-hammer_depth", ("replay", str(own), "--rate", "1"))


def make_bags(bags: Path, data: Path) -> None:
    """Simulated and imported bags that are not there yet."""
    bags.mkdir(parents=True, exist_ok=True)
    imports = {
        "cmu_icra16": ("cmu-icra16", data / "cmu_icra16" / "30_90_30_30_30_90__exp_08_11_30.txt"),
        "cmu_mocap": ("cmu-mocap", data / "cmu_mocap" / "robot_multi_push_3out_3.bag"),
    }
    for name, options in SIMULATED.items():
        if not (bags / name).exists():
            run("simulate", "--out", str(bags / name), "--pushes", "10", *options)
    for name, (kind, path) in imports.items():
        if path.exists() and not (bags / name).exists():
            run("import", kind, str(path), "--out", str(bags / name))


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    """One command of `push-ident`; ends the script where a bag cannot be made."""
    # The number of threads of a matrix product changes its last bits.
    environment = {name: value for name, value in os.environ.items() if not name.endswith("_NUM_THREADS")}
    done = subprocess.run([str(CLI), *arguments], capture_output=True, text=True, check=False, env=environment)
    if done.returncode and arguments[0] in ("simulate", "import"):
        sys.exit(f"push-ident {' '.join(arguments)}: {done.stderr.strip() or done.stdout.strip()}")
    return done


def command(case: Case, out: Path) -> list[str]:
    """Arguments of `push-ident`, with the folders of earlier cases in their place."""
    return [a.replace("{", f"{out}/").replace("}", "") if a.startswith("{") else a for a in case.arguments]


def record(out: Path, bags: Path, data: Path, only: str) -> None:
    """Run all cases whose name holds `only`; one that is there already is not run again."""
    make_bags(bags, data)
    out.mkdir(parents=True, exist_ok=True)
    for case in cases(bags, data):
        file, folder = out / f"{case.name}.json", out / case.name
        if only not in case.name or file.exists():
            continue
        started = time.perf_counter()
        with tempfile.TemporaryDirectory() as scratch:
            answer = Path(scratch) / "answer.json"
            done = run(*command(case, out), "--json", str(answer), "--out", str(folder))
            content: Any = json.loads(answer.read_text()) if answer.exists() else None
        file.write_text(json.dumps({"exit": done.returncode, "content": content}, indent=1, sort_keys=True))
        print(f"{case.name}: exit {done.returncode}, {time.perf_counter() - started:.0f} s", flush=True)


def equal(before: Any, after: Any, relative: float) -> bool:
    """Whether two values are the same; numbers within a relative tolerance, NaN equal to itself."""
    if before == after:
        return True
    numbers = all(isinstance(value, int | float) and not isinstance(value, bool) for value in (before, after))
    return numbers and ((math.isnan(before) and math.isnan(after)) or math.isclose(before, after, rel_tol=relative))


def differences(before: Any, after: Any, path: str = "", *, relative: float = 0.0) -> Iterator[str]:
    """Where two answers differ by more than a relative tolerance, a line each; texts for people and clocks aside."""
    if isinstance(before, dict) and isinstance(after, dict):
        for key in sorted(before.keys() | after.keys()):
            if key in PROSE | CLOCK:
                continue
            if key not in before or key not in after:
                yield f"{path}.{key}: only {'after' if key in after else 'before'}"
            else:
                yield from differences(before[key], after[key], f"{path}.{key}", relative=relative)
    elif isinstance(before, list) and isinstance(after, list):
        if len(before) != len(after):
            yield f"{path}: {len(before)} entries before, {len(after)} after"
        for i, (a, b) in enumerate(zip(before, after, strict=False)):
            yield from differences(a, b, f"{path}[{i}]", relative=relative)
    elif not equal(before, after, relative):
        yield f"{path}: {before!r} before, {after!r} after"


def compare(before: Path, after: Path) -> int:
    """Number of cases that differ, with their first differences printed."""
    names = sorted({p.name for folder in (before, after) for p in folder.glob("*.json")})
    wrong = 0
    for name in names:
        if not (before / name).exists() or not (after / name).exists():
            print(f"{name}: only {'after' if (after / name).exists() else 'before'}")
            wrong += 1
            continue
        found = list(differences(json.loads((before / name).read_text()), json.loads((after / name).read_text())))
        wrong += bool(found)
        print(f"{name}: {'equal' if not found else f'{len(found)} differences'}", *found[:5], sep="\n    ")
    print(f"{len(names) - wrong} of {len(names)} cases are equal to the last bit")
    return wrong


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(dest="command", required=True)
    recording = commands.add_parser("record")
    recording.add_argument("out", type=Path)
    recording.add_argument("--bags", type=Path, default=ROOT / "out" / "baseline" / "bags")
    recording.add_argument("--data", type=Path, default=ROOT.parent / "shared" / "data")
    recording.add_argument("--only", default="", metavar="WORD", help="cases whose name holds this")
    comparing = commands.add_parser("compare")
    comparing.add_argument("before", type=Path)
    comparing.add_argument("after", type=Path)
    given = parser.parse_args()
    if given.command == "record":
        record(given.out.resolve(), given.bags.resolve(), given.data.resolve(), given.only)
    else:
        sys.exit(compare(given.before, given.after) > 0)


if __name__ == "__main__":
    main()
