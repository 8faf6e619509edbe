"""The experiments of Song & Boularias (2020) on ground truth from Bullet, and what goes beyond them."""

from __future__ import annotations

from push_ident_sim.experiments.blind import EXPERIMENT as _BLIND
from push_ident_sim.experiments.cell import EXPERIMENT as _CELL
from push_ident_sim.experiments.convergence import EXPERIMENT as _CONVERGENCE
from push_ident_sim.experiments.coverage import EXPERIMENT as _COVERAGE
from push_ident_sim.experiments.experiment import Experiment
from push_ident_sim.experiments.live import EXPERIMENT as _LIVE
from push_ident_sim.experiments.maps import EXPERIMENT as _MAPS
from push_ident_sim.experiments.next_push import EXPERIMENT as _NEXT_PUSH
from push_ident_sim.experiments.online import EXPERIMENT as _ONLINE
from push_ident_sim.experiments.perception import EXPERIMENT as _PERCEPTION
from push_ident_sim.experiments.pushing import EXPERIMENT as _PUSHING
from push_ident_sim.experiments.real_protocol import EXPERIMENT as _REAL_PROTOCOL
from push_ident_sim.experiments.settle import EXPERIMENT as _SETTLE
from push_ident_sim.experiments.training import EXPERIMENT as _TRAINING

__all__ = ["EXPERIMENTS"]

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
