"""All studies, found in the folders beside this file."""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from importlib.util import find_spec
from pkgutil import iter_modules

from push_ident_sim import studies
from push_ident_sim.studies.common.base import Study
from push_ident_sim.studies.common.benchmark import Benchmark
from push_ident_sim.studies.common.experiment import Experiment

__all__ = ["BENCHMARKS", "EXPERIMENTS"]


def _discover() -> Iterator[Study]:
    for folder in iter_modules(studies.__path__, f"{studies.__name__}."):
        if folder.ispkg and find_spec(f"{folder.name}.study"):
            yield import_module(f"{folder.name}.study").STUDY


_ALL = sorted(_discover(), key=lambda study: study.place)

EXPERIMENTS: dict[str, Experiment] = {study.name: study for study in _ALL if isinstance(study, Experiment)}
"""By name, in the order of the report."""
BENCHMARKS: dict[str, Benchmark] = {study.name: study for study in _ALL if isinstance(study, Benchmark)}
"""By name, in the order of the report."""
