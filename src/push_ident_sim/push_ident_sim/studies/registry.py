"""All studies, in the order of their list."""

from __future__ import annotations

from push_ident_sim.studies import convergence, coverage, demo, edge, goals, maps, real_protocol
from push_ident_sim.studies.bench import batches, engine, frames, identification
from push_ident_sim.studies.blind import study as blind
from push_ident_sim.studies.common.study import Benchmark, Experiment
from push_ident_sim.studies.paths import study as paths
from push_ident_sim.studies.pusht import study as pusht
from push_ident_sim.studies.recorded import study as recorded
from push_ident_sim.studies.sensors import study as sensors

__all__ = ["BENCHMARKS", "EXPERIMENTS"]

EXPERIMENTS: dict[str, Experiment] = {
    module.STUDY.name: module.STUDY
    for module in (convergence, maps, coverage, real_protocol, blind, recorded, demo, goals, edge, paths, pusht, sensors)
}
BENCHMARKS: dict[str, Benchmark] = {module.STUDY.name: module.STUDY for module in (engine, batches, identification, frames)}
