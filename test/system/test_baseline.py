"""What the command line answers about fixed bags is what it answered when the answers were stored.

A redesign must not change a number. After a change that is meant to change them, store them anew and look at the difference:
`PUSH_IDENT_STORE_BASELINE=1 pytest test/system/test_baseline.py`. The full set of bags: `tools/baseline.py`.
"""

from __future__ import annotations

import importlib.util
import json
import os
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import llvmlite.binding
import numba
import numpy as np
import pytest
import scipy

from helpers.commands import run_in_one_process
from helpers.paths import DATA, ROOT, recording

STORED = Path(__file__).parent / "baseline"
STORE = "PUSH_IDENT_STORE_BASELINE"
CASES = {
    "hammer_depth": ("identify-hammer_depth", "predict-hammer_depth", "diagnose-hammer_depth"),
    "tilt": ("identify-tilt", "predict-tilt", "solver-fast_gradient-tilt", "diagnose-tilt"),
    "contract_sample": ("identify-contract_sample", "predict-contract_sample", "diagnose-contract_sample"),
}
"""Of the cases of `tools/baseline.py`, by bag: depth of an object, simulated poses on a tilted table, a recording of another maker."""
OTHER_MACHINE = 1e-2
"""Relative tolerance where processor or libraries are not those of the stored answers: sums are then rounded differently. With kernels
compiled for any x86-64 processor and OpenBLAS for Haswell, a log evidence near zero changed by 1.3e-3, the rest by less than 4e-5."""
OTHERWISE_THERE = frozenset({"combinations", "cell_error_std_m", "within_90", "next_push", "account", "gap", "motion", "remainder_m"})
"""Not compared there as the rest: combinations of unknowns have an arbitrary sign; predictions draw models along them; fits without the
held-out pushes end at a kink of the cost or at the next one; the best of many pushes may be one nearly as good."""
HELD_OUT = 0.1
"""Relative tolerance of mean errors on held-out pushes there; by those kernels and OpenBLAS, up to 0.015 (0.07 of single pushes)."""


def machine() -> dict[str, str]:
    """What rounding depends on."""
    blas = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    return {
        "processor": llvmlite.binding.get_host_cpu_name(),
        "features": llvmlite.binding.get_host_cpu_features().flatten(),
        "numpy": np.__version__,
        "blas": f"{blas['name']} {blas['version']}",
        "scipy": scipy.__version__,
        "numba": numba.__version__,
        "threads": "1",
    }


@pytest.fixture(scope="module")
def baseline() -> ModuleType:
    spec = importlib.util.spec_from_file_location("baseline", ROOT / "tools" / "baseline.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # its dataclasses look there for their module
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def answers(baseline: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], dict[str, Any]]:
    """The cases of a bag, answered by one process with one thread."""

    @cache
    def answers_of(bag: str) -> dict[str, Any]:
        out = tmp_path_factory.mktemp("baseline")
        cases = [case for case in baseline.cases(STORED / "bags", DATA) if case.name in CASES[bag]]
        calls = [[*baseline.command(case, out), "--out", str(out / case.name), "--json", str(out / f"{case.name}.json")] for case in cases]
        codes, n_compiled = run_commands(calls)
        if n_compiled:
            # A kernel rounds otherwise in the process that compiles it than in those that read it from the disk.
            codes, n_compiled = run_commands(calls)
        assert not n_compiled, f"{n_compiled} kernels are compiled again in every process"
        contents = [json.loads(file.read_text()) if (file := Path(call[-1])).exists() else None for call in calls]
        return {case.name: {"exit": code, "content": content} for case, code, content in zip(cases, codes, contents, strict=True)}

    return answers_of


def run_commands(calls: list[list[str]]) -> tuple[list[int], int]:
    """Exit status of each command, all in one process with one thread, and the number of kernels that it had to compile."""
    threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    done, n_compiled = run_in_one_process([["push-ident", *call] for call in calls], os.environ | threads)
    return [code for code, _ in done], n_compiled


def without(keys: frozenset[str], answer: Any) -> Any:
    """An answer without some of its keys, at any depth."""
    if isinstance(answer, dict):
        return {key: without(keys, value) for key, value in answer.items() if key not in keys}
    return [without(keys, value) for value in answer] if isinstance(answer, list) else answer


def comparable(answer: Any) -> Any:
    """What another machine answers as well: rivals of equal evidence may change places."""
    answer = without(OTHERWISE_THERE, answer)
    if answer["content"] and "ranking" in answer["content"]:
        answer["content"]["ranking"].sort(key=lambda entry: entry["name"])
    return answer


def held_out(answer: Any) -> dict[str, float]:
    """Mean errors of a diagnosis on held-out pushes [m]; none of other answers."""
    content = answer["content"] or {}
    return {f"{of}.{key}": content[of][key] for of in ("gap", "motion") if of in content for key in ("before_m", "after_m", "noise_m")}


BAG_AND_CASE = [
    pytest.param(bag, name, marks=() if bag == "hammer_depth" else pytest.mark.long) for bag, names in CASES.items() for name in names
]


@pytest.mark.parametrize(("bag", "name"), BAG_AND_CASE)
def test_answer_is_the_stored_one(bag: str, name: str, baseline: ModuleType, answers: Callable[[str], dict[str, Any]]) -> None:
    if bag == "contract_sample":
        recording("contract_sample", "bag")
    file, fingerprint = STORED / f"{name}.json", STORED / "machine.json"
    answer = without(baseline.PROSE | baseline.CLOCK, answers(bag)[name])
    if os.environ.get(STORE):
        file.write_text(json.dumps(answer, sort_keys=True) + "\n")
        fingerprint.write_text(json.dumps(machine(), indent=1, sort_keys=True) + "\n")
    stored = json.loads(file.read_text())
    if json.loads(fingerprint.read_text()) == machine():
        found = list(baseline.differences(stored, answer))
    else:
        found = list(baseline.differences(held_out(stored), held_out(answer), relative=HELD_OUT))
        found += baseline.differences(comparable(stored), comparable(answer), relative=OTHER_MACHINE)
    assert not found, "\n".join([f"{len(found)} differences from {file.name}", *found[:10]])


def test_comparison_sees_the_last_bit_and_a_missing_name(baseline: ModuleType) -> None:
    before = {"map": [0.1, 0.2], "verdict": "named", "sentence": "one", "size": float("nan")}
    next_bit = {**before, "sentence": "another", "map": [0.1, np.nextafter(0.2, 1.0)]}
    assert list(baseline.differences(before, next_bit)) and not list(baseline.differences(before, next_bit, relative=1e-12))
    assert list(baseline.differences(before, {**before, "verdict": "no_gap"}, relative=1.0))
    assert list(baseline.differences(before, {key: before[key] for key in ("map", "verdict")}))
