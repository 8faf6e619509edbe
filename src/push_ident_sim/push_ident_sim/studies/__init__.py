"""Studies: the experiments of Song & Boularias (2020) and beyond, and the benchmarks; one folder each."""

from __future__ import annotations

from push_ident_sim.studies.autograd.study import BENCHMARK as _AUTOGRAD
from push_ident_sim.studies.blind.study import EXPERIMENT as _BLIND
from push_ident_sim.studies.bullet.study import BENCHMARK as _BULLET
from push_ident_sim.studies.cell.study import EXPERIMENT as _CELL
from push_ident_sim.studies.common.benchmark import Benchmark
from push_ident_sim.studies.common.experiment import Experiment
from push_ident_sim.studies.convergence.study import EXPERIMENT as _CONVERGENCE
from push_ident_sim.studies.coverage.study import EXPERIMENT as _COVERAGE
from push_ident_sim.studies.engine.study import BENCHMARK as _ENGINE
from push_ident_sim.studies.live.study import EXPERIMENT as _LIVE
from push_ident_sim.studies.maps.study import EXPERIMENT as _MAPS
from push_ident_sim.studies.methods.study import BENCHMARK as _METHODS
from push_ident_sim.studies.next_push.study import EXPERIMENT as _NEXT_PUSH
from push_ident_sim.studies.online.study import EXPERIMENT as _ONLINE
from push_ident_sim.studies.perception.study import EXPERIMENT as _PERCEPTION
from push_ident_sim.studies.pushing.study import EXPERIMENT as _PUSHING
from push_ident_sim.studies.real_protocol.study import EXPERIMENT as _REAL_PROTOCOL
from push_ident_sim.studies.settle.study import EXPERIMENT as _SETTLE
from push_ident_sim.studies.solve.study import BENCHMARK as _SOLVE
from push_ident_sim.studies.training.study import EXPERIMENT as _TRAINING

__all__ = ["BENCHMARKS", "EXPERIMENTS"]

EXPERIMENTS: dict[str, Experiment] = {
    e.name: e
    for e in (
        _CONVERGENCE,
        _MAPS,
        _TRAINING,
        _REAL_PROTOCOL,
        _COVERAGE,
        _NEXT_PUSH,
        _ONLINE,
        _LIVE,
        _CELL,
        _PERCEPTION,
        _PUSHING,
        _SETTLE,
        _BLIND,
    )
}
"""By name, in the order of the report."""

BENCHMARKS: dict[str, Benchmark] = {b.name: b for b in (_ENGINE, _AUTOGRAD, _BULLET, _SOLVE, _METHODS)}
"""By name, in the order of the report."""
