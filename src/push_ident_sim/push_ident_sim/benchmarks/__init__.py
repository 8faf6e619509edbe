"""How long things take and how exact they are: the compiled engine, against its rivals in the same run, and identification."""

from __future__ import annotations

from push_ident_sim.benchmarks.autograd import BENCHMARK as _AUTOGRAD
from push_ident_sim.benchmarks.benchmark import Benchmark
from push_ident_sim.benchmarks.bullet import BENCHMARK as _BULLET
from push_ident_sim.benchmarks.engine import BENCHMARK as _ENGINE
from push_ident_sim.benchmarks.methods import BENCHMARK as _METHODS
from push_ident_sim.benchmarks.solve import BENCHMARK as _SOLVE

__all__ = ["BENCHMARKS"]

BENCHMARKS: dict[str, Benchmark] = {b.name: b for b in (_ENGINE, _AUTOGRAD, _BULLET, _SOLVE, _METHODS)}
"""By name, in the order of the report."""
