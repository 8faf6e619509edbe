"""All studies, in the order of their list."""

from __future__ import annotations

from push_ident_sim.studies import (
    convergence,
    coverage,
    demo,
    edge,
    few_pushes,
    goals,
    held_out,
    injected,
    labelled,
    maps,
    obstacles,
    paths,
    pusht,
    recorded,
    recorded_scenes,
    scenes,
    sensors,
    several,
    stable_pushes,
    two_fingers,
)
from push_ident_sim.studies.bench import batches, engine, exports, fix, frames, identification, nodes, rivals
from push_ident_sim.studies.blind import study as blind
from push_ident_sim.studies.common.study import Benchmark, Experiment

EXPERIMENTS: dict[str, Experiment] = {
    module.STUDY.name: module.STUDY
    for module in (
        convergence,
        maps,
        coverage,
        few_pushes,
        blind,
        recorded,
        held_out,
        injected,
        scenes,
        recorded_scenes,
        demo,
        goals,
        edge,
        obstacles,
        several,
        paths,
        pusht,
        sensors,
        labelled,
        stable_pushes,
        two_fingers,
    )
}
BENCHMARKS: dict[str, Benchmark] = {
    module.STUDY.name: module.STUDY for module in (engine, batches, identification, frames, nodes, exports, fix, rivals)
}
