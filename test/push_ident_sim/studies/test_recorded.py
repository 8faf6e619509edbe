"""Recordings of others: sets in a folder, draws of their pushes, and what is said of a law of friction."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from push_ident.bags.importers import import_mit
from push_ident.errors import InputError
from push_ident.identification.observing.observation import observe_push
from push_ident.physics.scenario import PushScenario
from push_ident.physics.simulation import simulate
from push_ident_sim.recordings.truth import true_model
from push_ident_sim.studies.common.experiment import Case, CaseResult
from push_ident_sim.studies.common.files import write_json
from push_ident_sim.studies.recorded.rehearsal import RehearsalSettings, plate_of, write_rehearsal
from push_ident_sim.studies.recorded.sets import draw_pushes, find_sets, known_of
from push_ident_sim.studies.registry import EXPERIMENTS

STUDY = EXPERIMENTS["recorded"]
EXACT = RehearsalSettings(n_pushes=4, shift=(1e-9, 1e-9), latency=0.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("recordings")
    write_rehearsal(folder, EXACT, surfaces={"even": {}})
    import_mit([folder / "even"], folder / "as" / "bag")
    return folder


def test_every_set_of_a_folder_is_found_by_its_form(folder: Path, tmp_path: Path) -> None:
    found = find_sets(folder)
    assert {name: len(one.paths) for name, one in found.items()} == {"even-rect1": 4, "as-bag": 1}
    assert STUDY.find is not None and set(STUDY.find(folder)) == set(found)
    for wrong, reason in ((tmp_path, "no recording in it"), (tmp_path / "elsewhere", "no such folder")):
        with pytest.raises(InputError, match=reason):
            find_sets(wrong)


def test_files_and_their_bag_give_the_same_pushes_in_the_order_in_which_they_were_made(folder: Path) -> None:
    found = find_sets(folder)
    files, bag = (
        draw_pushes(found[name], 9, np.random.default_rng(0), ends_only=False, with_forces=True) for name in ("even-rect1", "as-bag")
    )
    assert files.n_all == bag.n_all == 4 and files.mass == 0.8374 and bag.mass is None
    for one, other in zip(files.records, bag.records, strict=True):
        np.testing.assert_allclose(one.poses.pose, other.poses.pose, atol=1e-9)
    # By name the files have another order than by time.
    names = [file.name for file in found["even-rect1"].paths]
    assert [name[-9:] for name in names] != sorted(name[-9:] for name in names)
    starts = [json.loads(file.read_text())["object_pose"][0][1] for file in sorted(found["even-rect1"].paths, key=lambda f: f.name[-9:])]
    np.testing.assert_allclose([record.poses.pose[0, 0] for record in files.records], starts)


def test_fewer_pushes_ends_and_no_forces_are_drawn_as_asked(folder: Path) -> None:
    found = find_sets(folder)["even-rect1"]
    drawn = draw_pushes(found, 2, np.random.default_rng(1), ends_only=True, with_forces=False)
    assert len(drawn.records) == 2 and all(len(r.poses.time) == 2 and r.wrench is None for r in drawn.records)


def test_rehearsed_pushes_are_those_of_the_published_plate(folder: Path) -> None:
    """The core's own engine follows them, the force included: a plate of another size or weight would not."""
    drawn = draw_pushes(find_sets(folder)["even-rect1"], 4, np.random.default_rng(0), ends_only=False, with_forces=True)
    model, moved = true_model(plate_of("rect1")), []
    for record in drawn.records:
        assert observe_push(record).touched and record.wrench is not None
        end = simulate(model, PushScenario(record.pusher, record.poses.pose[0], record.poses.time[-1:])).pose[-1]
        error = np.abs(end - record.poses.pose[-1])
        moved.append(float(np.hypot(*(record.poses.pose[-1] - record.poses.pose[0])[:2])))
        assert np.hypot(error[0], error[1]) < 1e-3 + 0.05 * moved[-1]
        assert np.linalg.norm(record.wrench.force, axis=1).max() > 0.8
    assert max(moved) > 0.02


def test_what_authors_measured_is_read_by_patterns_of_names(folder: Path, tmp_path: Path) -> None:
    assert known_of(folder, "even-rect1")["friction"] == 0.25 and known_of(folder, "other") == {} == known_of(tmp_path, "even-rect1")
    (tmp_path / "known.json").write_text("[1]")
    with pytest.raises(InputError, match="an object of objects"):
        known_of(tmp_path, "even-rect1")


def outcome(verdict: str, named: list[str], probability: float) -> dict[str, Any]:
    effects = [{"name": name, "parameters": {"w": -0.02}, "std": {"w": 1e-3}, "evidence": 20.0} for name in named]
    passed = verdict != "not_trustworthy"
    return {
        "n_pushes": 14, "n_all": 60, "forces": True, "mass_kg": 0.8, "speed_mps": [0.02, 0.5], "travel_m": 0.03, "notes": [],
        "verdict": verdict, "sentence": "", "confusable": [], "effects": effects, "seconds": 10.0,
        "failed_gates": [] if passed else [{"found": "1 of 1 pushes touch the object", "remedy": "Record more."}],
        "probabilities": {"wear": probability, "nothing": 1 - probability, "something_else": 0.0} if passed else {},
        "gap": {"before_m": 3e-3, "after_m": 1e-3, "noise_m": 5e-4} if passed else None,
        "friction": 0.25 if passed else None,
        "laws": {"wear": {"evidence": 20.0, "smallest": None}} if passed else {},
        "known": {"friction": 0.28, "effects": {"wear": "falls by a tenth"}, "source": "they"},
    }  # fmt: skip


def test_table_says_what_was_found_what_was_measured_and_why_a_set_was_refused(tmp_path: Path) -> None:
    found = [outcome("named", ["wear"], 0.95), outcome("no_gap", [], 0.35)]
    results = [CaseResult(Case("pu-hex", seed, "14-pushes"), values) for seed, values in enumerate(found)]
    results.append(CaseResult(Case("abs-hex", 0, "14-pushes"), outcome("not_trustworthy", [], 0.0)))
    write_json(tmp_path / "recorded.json", STUDY.summarise(results))
    summary = json.loads((tmp_path / "recorded.json").read_text())
    text = STUDY.tables(summary)
    assert "wear 1×, -0.02" in text and "0.250 (0.250-0.250), measured 0.280" in text and "falls by a tenth" in text
    assert "1 of 2; 0.65; –" in text and "- abs-hex, 14-pushes: 1 of 1 pushes touch the object" in text
    (name,) = STUDY.draw(summary, tmp_path)
    assert (tmp_path / name).stat().st_size > 5000
