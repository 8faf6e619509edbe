"""Real node processes over real DDS: a bag is played, a map comes out, and it is the one found offline."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from helpers.objects import hammer, random_records
from helpers.paths import ROOT
from push_ident.bags.records import write_records
from push_ident.types import PushRecord

CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]


def run(*args: object, timeout: float = 120.0) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*CLI, *map(str, args)], capture_output=True, text=True, timeout=timeout)


@pytest.fixture(scope="module")
def records() -> list[PushRecord]:
    return random_records(hammer(1), 3, 1)


@pytest.mark.live
def test_bag_played_as_fast_as_possible_gives_the_map_found_offline_and_counts_what_was_not_learned(
    records: list[PushRecord], tmp_path: Path
) -> None:
    bag, with_a_miss = tmp_path / "hammer", tmp_path / "with_a_miss"
    write_records(bag, records)
    far = replace(records[0].pusher, position=records[0].pusher.position + 0.4)
    write_records(with_a_miss, [*records, replace(records[0], pusher=far)])
    live = run("replay", with_a_miss, "--rate", 0, "--out", tmp_path / "live", "--json", tmp_path / "live.json")
    assert live.returncode == 1 and "3 of 4 pushes of the bag were learned; 1 without contact" in live.stderr, live.stdout + live.stderr
    offline = run("identify", bag, "--json", tmp_path / "offline.json")
    assert offline.returncode == 0, offline.stderr
    a, b = (json.loads((tmp_path / f"{name}.json").read_text()) for name in ("live", "offline"))
    assert a["n_pushes"] == 3
    products = [np.array(x["map"]["mass_friction"]) for x in (a, b)]
    products = [p / p.sum() for p in products]
    deviation = np.array(b["map"]["mass_friction_std"]) / np.sum(b["map"]["mass_friction"])
    # The same data, warm-started push by push: well within the uncertainty of the fit.
    assert np.max(np.abs(products[0] - products[1]) / deviation) < 0.5
    assert (tmp_path / "live" / "model.json").exists()


@pytest.mark.live
def test_no_image_of_a_bag_is_lost_however_fast_it_is_played(tmp_path: Path) -> None:
    done = run("replay", ROOT / "bags" / "hammer_depth", "--rate", 0, "--json", tmp_path / "live.json", timeout=300.0)
    assert done.returncode == 0, done.stdout + done.stderr
    content = json.loads((tmp_path / "live.json").read_text())
    assert content["n_pushes"] == 4 and content["counts"]["pushes"] == "4"


def test_doctor_names_what_is_missing_when_nothing_runs(tmp_path: Path) -> None:
    done = run("doctor", "--seconds", 1, "--json", tmp_path / "doctor.json")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "doctor.json").read_text())
    assert content["ros"]["middleware"] == "rmw_fastrtps_cpp"
    assert any("push-ident up sim" in problem for problem in content["problems"])


@pytest.mark.alone
def test_demo_sees_pushes_identifies_and_predicts_in_the_live_simulated_cell(tmp_path: Path) -> None:
    done = run("demo", "--n-train", 1, "--n-test", 1, "--out", tmp_path, "--json", tmp_path / "demo.json", timeout=280.0)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    content = json.loads((tmp_path / "demo.json").read_text())
    assert len(content["training"]) == 1 and len(content["per_push"]) == 1
    # One push determines little, but the pose, the outline and the prediction must hang together.
    assert content["per_push"][0]["predicted_m"] < 0.02 and content["per_push"][0]["ways"]
    assert "push 2 predicted, expected to" in done.stdout
    folder = next(path for path in tmp_path.iterdir() if path.is_dir())
    assert {"bag", "model.json", "report.html", "result.json", "log"} <= {path.name for path in folder.iterdir()}
    assert run("identify", folder / "bag").returncode == 0
