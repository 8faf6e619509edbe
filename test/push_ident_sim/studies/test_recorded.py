"""Recordings of others: sets in a folder, draws of their pushes, and what is said of a known law of friction."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from push_ident.bags.importers import import_mit
from push_ident.errors import InputError
from push_ident.identification.observation import observe_push
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.common.files import write_json
from push_ident_sim.studies.recorded.rehearsal import RehearsalSettings, write_rehearsal
from push_ident_sim.studies.recorded.sets import draw_pushes, find_sets, known_of
from push_ident_sim.studies.registry import EXPERIMENTS

FEW = RehearsalSettings(n_pushes=4)
STUDY = EXPERIMENTS["recorded"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write_rehearsal(folder, FEW, surfaces={"even": {}, "grain": {"table_anisotropy": (0.2, 0.0)}})
    import_mit([folder / "even"], folder / "as" / "bag")
    return folder


def test_every_set_of_a_folder_is_found_by_its_form(folder: Path) -> None:
    found = find_sets(folder)
    assert set(found) == {"even-rect1", "grain-rect1", "as-bag"} == set(STUDY.find(folder)) if STUDY.find else False
    assert [len(found[name].paths) for name in ("even-rect1", "as-bag")] == [4, 1]
    with pytest.raises(InputError, match="no recording in it"):
        find_sets(folder / "as" / "bag" / "..", ) if False else find_sets(_empty(folder))
    with pytest.raises(InputError, match="no such folder"):
        find_sets(folder / "elsewhere")


def _empty(folder: Path) -> Path:
    empty = folder / "empty"
    empty.mkdir(exist_ok=True)
    return empty
