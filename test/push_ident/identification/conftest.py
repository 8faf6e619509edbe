"""Pushes of engines, of a simulator that is not ours, and of real arms, for what must hold wherever pushes come from."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Final

import pytest

from helpers.diagnosis import simulated_pushes
from helpers.paths import ROOT, recording
from push_ident.bags.importers import import_cmu_icra16, import_cmu_mocap
from push_ident.offline.loading import load_pushes
from push_ident.types import PushRecord

EFFECTS: Final[tuple[dict[str, list[float]], ...]] = (
    {"table_tilt": [0.06, 0.06]},
    {"table_anisotropy": [0.4, 0.3]},
    {"tool_offset": [6e-3, 6e-3]},
    {"pusher_lag": [0.06]},
    {"pose_latency": [0.1]},
    {"restitution": [0.9]},
)
"""Three times the usual size and more."""


def _imported(importer: Callable[[Path, Path], object], *parts: str) -> Callable[[Path], list[PushRecord]]:
    def read(folder: Path) -> list[PushRecord]:
        importer(recording(*parts), folder / "bag")
        return load_pushes([folder / "bag"]).records

    return read


_SOURCES: Final[dict[str, Callable[[Path], list[PushRecord]]]] = {
    "own engine": lambda folder: simulated_pushes(4, 3),
    "with effects": lambda folder: [record for effects in EFFECTS for record in simulated_pushes(1, 4, effects)],
    "bullet": lambda folder: load_pushes([ROOT / "test" / "system" / "baseline" / "bags" / "tilt"]).records[:4],
    "another maker": lambda folder: load_pushes([recording("contract_sample", "bag")]).records[:4],
    "real arm": _imported(import_cmu_icra16, "cmu_icra16", "30_90_30_30_30_90__exp_08_11_30.txt"),
    "motion capture": _imported(import_cmu_mocap, "cmu_mocap", "robot_multi_push_3out_3.bag"),
}


@pytest.fixture(scope="module", params=_SOURCES)
def pushes(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[PushRecord]:
    return _SOURCES[request.param](tmp_path_factory.mktemp("bag"))
