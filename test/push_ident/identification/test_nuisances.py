"""What a recording does not give is fitted beside the maps: the pusher's radius, and the noise of poses that no other frame checks."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from helpers.objects import hammer, random_records
from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter
from push_ident.cli.main import app
from push_ident.identification.fitting.fit import FitOptions
from push_ident.identification.identify import identify
from push_ident.identification.observing.observation import NoiseModel
from push_ident.identification.predicting.prediction import held_out_errors
from push_ident.offline.loading import load_pushes
from push_ident.types import PoseTrack, PushRecord

RADIUS = 0.008
"""Of `random_records` [m]."""
RECORDS = random_records(hammer(3), 12, 3)
TRAIN, TEST = RECORDS[:6], RECORDS[6:]


@pytest.fixture
def bag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Of pushes, without the radius of the pusher."""
    monkeypatch.setattr(BagWriter, "write_pusher_shape", lambda *_: None)
    write_records(tmp_path / "bag", TRAIN)
    return tmp_path / "bag"


def test_missing_radius_is_found_from_the_contacts(bag: Path) -> None:
    loaded = load_pushes([bag])
    assert len(loaded.nuisances) == 1 and any("radius" in note and "assumed" in note for note in loaded.notes)
    assumed = loaded.records[0].pusher.radius
    assert assumed == pytest.approx(RADIUS, abs=3e-3)
    result = identify(loaded.records, effects=loaded.nuisances)
    (offset,) = result.posterior.effects.values
    assert assumed + offset == pytest.approx(RADIUS, abs=5e-4)
    test = [replace(record, pusher=replace(record.pusher, radius=assumed)) for record in TEST]
    with_offset = held_out_errors(result.model, test, effects=result.posterior.effects).mean()
    assert with_offset < 0.8 * held_out_errors(identify(loaded.records).model, test).mean()


def test_command_fits_what_the_bag_lacks_and_says_so(bag: Path, tmp_path: Path) -> None:
    ran = CliRunner().invoke(app, ["identify", str(bag), "--json", str(tmp_path / "out.json"), "--out", str(tmp_path / "model")])
    assert ran.exit_code == 0, ran.output
    assert ".offset: " in ran.output
    assert any("assumed" in note for note in json.loads((tmp_path / "out.json").read_text())["notes"])
    predicted = CliRunner().invoke(app, ["predict", str(tmp_path / "model" / "model.json"), str(bag), "--json", str(tmp_path / "p.json")])
    assert predicted.exit_code == 0, predicted.output


def ends_only(record: PushRecord, stated: float, rng: np.random.Generator) -> PushRecord:
    """First and last pose with noise of 1 mm and 0.02 rad, of which `stated` times as much is stated."""
    std = np.array([1e-3, 1e-3, 0.02])
    pose = np.array([record.poses.pose[:5].mean(axis=0), record.poses.pose[-5:].mean(axis=0)]) + std * rng.normal(size=(2, 3))
    covariance = np.broadcast_to(np.diag((stated * std) ** 2), (2, 3, 3))
    return replace(record, poses=PoseTrack(record.poses.time[[0, -1]], pose, covariance))


@pytest.mark.parametrize("stated", [pytest.param(1 / 3, marks=pytest.mark.long), 3.0])
def test_noise_of_unchecked_poses_is_set_by_the_pushes(stated: float) -> None:
    rng = np.random.default_rng(0)
    records = [ends_only(record, stated, rng) for record in RECORDS[:10]]
    factor = identify(records).posterior.pose_noise_factor
    assert factor is not None and abs(np.log(factor * stated)) < 0.6, "nothing learned: 1.1"
    assert identify(TRAIN[:1]).posterior.pose_noise_factor is None
    given = FitOptions(noise=NoiseModel(single_frame_inflation=1.0))
    assert identify(records[:1], options=given).posterior.pose_noise_factor is None
