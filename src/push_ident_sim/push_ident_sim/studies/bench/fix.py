"""How long `push-ident fix` takes for a scene of one body and for one whose object is made of cells, and what is left of their gap."""

from __future__ import annotations

import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

from push_ident.identification.unknowns.mechanics import uniform_model
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import load_pushes
from push_ident_sim.studies.common.study import Benchmark, Json, Piece, Settings, Target
from push_ident_sim.studies.common.tables import markdown_table, millimetres
from push_ident_sim.studies.scenes import plain_scene

_OBJECTS: Final = ("hammer", "book")
_N_PUSHES: Final = 14
_TILT: Final = "table_tilt=0.05,0.02"
_LIMITS: Final = {"one body": 30.0, "cells": 180.0}
"""Aims for the wall clock [s]."""


def _pieces(settings: Settings) -> list[Piece]:
    if settings.quick:
        return [Piece("hammer, one body", _measure, ("hammer", "one body", 4, settings.seed))]
    cases = [(name, kind) for name in _OBJECTS for kind in _LIMITS]
    return [Piece(", ".join(case), _measure, (*case, _N_PUSHES, settings.seed)) for case in cases]


def _measure(name: str, kind: str, n_pushes: int, seed: int) -> Json:
    with tempfile.TemporaryDirectory() as folder:
        bag, result = Path(folder) / "bag", Path(folder) / "gap.json"
        _push_ident("simulate", "--out", bag, "--object", name, "--pushes", n_pushes, "--seed", seed, "--effect", _TILT)
        record, prior = load_pushes([bag]).records[0], Prior()
        scene = plain_scene(Path(folder), record.shape.outline, record.pusher.radius, prior.pusher_friction)
        if kind == "cells":
            scene.with_object(uniform_model(record.shape, prior)).write(scene.path)
        used, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        bodies = ("--object-body", scene.object_body, "--pusher-body", scene.tool_body)
        _push_ident("fix", scene.path, bag, *bodies, "--out", Path(folder) / "fixed.xml", "--json", result)
        wall, now = time.perf_counter() - started, resource.getrusage(resource.RUSAGE_CHILDREN)
        stages = json.loads(result.read_text(encoding="utf-8"))["stages"]
    means = [sum(stage["errors"]) / n_pushes for stage in stages]
    return {
        "object": name,
        "cells": len(record.shape.cells.centres),
        "scene": kind,
        "seed": seed,
        "wall_s": wall,
        "processor_s": now.ru_utime + now.ru_stime - used.ru_utime - used.ru_stime,
        "before_m": means[0],
        "after_m": means[-2],
        "model_m": means[-1],
    }


def _push_ident(*arguments: object) -> None:
    subprocess.run([sys.executable, "-m", "push_ident.cli", *map(str, arguments)], check=True, stdout=subprocess.DEVNULL)


def _targets(summary: Json) -> list[Target]:
    targets = []
    for kind, limit in _LIMITS.items():
        if seconds := [row["wall_s"] for row in summary["scenes"] if row["scene"] == kind]:
            what = f"correcting a scene of {kind} by {_N_PUSHES} pushes, the slowest"
            targets.append(Target(what, f"≤ {limit:.0f} s", f"{max(seconds):.0f} s (wall)", max(seconds) <= limit))
    return targets


def _tables(summary: Json) -> str:
    head = ["object", "scene", "wall [s]", "processor [s]", "as it is [mm]", "corrected [mm]", "the model [mm]"]
    rows = []
    for row in summary["scenes"]:
        scene = "one body" if row["scene"] == "one body" else f"{row['cells']} cells"
        errors = [millimetres(row[key]) for key in ("before_m", "after_m", "model_m")]
        rows.append([row["object"], scene, f"{row['wall_s']:.0f}", f"{row['processor_s']:.0f}", *errors])
    return markdown_table(head, rows)


def _summarise(results: Sequence[Json]) -> Json:
    return {"scenes": list(results)}


STUDY = Benchmark(
    name="fix",
    title="Correcting a scene of MuJoCo",
    question=(
        f"`push-ident fix`, from {_N_PUSHES} pushes on a table that tilts, made by the planar engine, in a fresh process with all cores: "
        "an object as one even body, or of even cells. Errors: on pushes that no fit has seen."
    ),
    pieces=_pieces,
    summarise=_summarise,
    targets=_targets,
    tables=_tables,
)
