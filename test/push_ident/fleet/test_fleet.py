"""Many bags through Ray: real workers, real bags, real Parquet."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from pyarrow.parquet import read_table
from typer.testing import CliRunner

from push_ident.cli.main import app
from push_ident.errors import InputError
from push_ident.fleet import FleetOptions, find_jobs, run_fleet, write_index, write_table
from push_ident.fleet.job import Outcome
from push_ident.identification.results.model_file import load_model

pytestmark = pytest.mark.live

OPTIONS = FleetOptions(max_seconds=5.0)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two bags that can be identified, in folders of different depth, and two that cannot."""
    folder = tmp_path_factory.mktemp("bags")
    for seed, name in enumerate(("monday/a", "tuesday/shift2/b")):
        (folder / name).parent.mkdir(parents=True)
        result = CliRunner().invoke(
            app, ["simulate", "--out", str(folder / name), "--pushes", "5", "--seed", str(seed), "--model", str(seed)]
        )
        assert result.exit_code == 0, result.output
    (folder / "monday" / "cut.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    (folder / "monday" / "noise.mcap").write_bytes(bytes(range(256)) * 20)
    return folder


def test_finds_bags_at_any_depth_once_and_knows_them_again(bags: Path) -> None:
    jobs = find_jobs([bags, bags / "monday"], OPTIONS)
    assert [job.bag.name for job in jobs] == ["a", "cut.mcap", "noise.mcap", "b"]
    assert [job.key for job in find_jobs([bags], OPTIONS)] == [job.key for job in jobs]
    assert not {job.key for job in find_jobs([bags], FleetOptions(max_seconds=6.0))} & {job.key for job in jobs}
    with pytest.raises(InputError, match="does not exist"):
        find_jobs([bags / "wednesday"], OPTIONS)


def test_one_bad_bag_stops_nothing_a_second_run_does_nothing_again_and_none_readable_is_a_failure(bags: Path, tmp_path: Path) -> None:
    jobs = find_jobs([bags], OPTIONS)
    seen: list[Outcome] = []
    places: set[float] = set()

    def see(outcome: Outcome) -> None:
        import ray  # not before the run: Ray reads the environment of a run when it is imported

        seen.append(outcome)
        places.add(ray.cluster_resources()["CPU"])

    outcomes = run_fleet(jobs, OPTIONS, tmp_path, workers=2, on_outcome=see)
    assert [o["state"] for o in outcomes] == ["done", "failed", "failed", "done"]
    assert all(o["error"] for o in outcomes if o["state"] == "failed")
    # A worker that starts late may find no bag left: there were places for two, and nothing was done in this process.
    assert places == {2.0} and os.getpid() not in {o["process"] for o in outcomes}
    assert sorted(o["bag"] for o in seen) == sorted(str(job.bag) for job in jobs)
    for outcome in outcomes:
        if outcome["state"] == "done":
            assert outcome["result"]["test"]["pushes"] == [3]
            object_id, posterior = load_model(tmp_path / outcome["model_file"])
            assert object_id == outcome["result"]["object_id"]
            assert posterior.model.mass.tolist() == pytest.approx(outcome["result"]["map"]["mass"])
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "bags").iterdir()}
    again = run_fleet(jobs, OPTIONS, tmp_path, workers=2)
    assert again == json.loads(json.dumps(outcomes))
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "bags").iterdir()} == before

    write_table(tmp_path / "results.parquet", again)
    rows = read_table(tmp_path / "results.parquet").to_pylist()
    assert [row["state"] for row in rows] == [o["state"] for o in outcomes]
    assert rows[0]["test_identified_m"] == again[0]["result"]["test"]["identified_m"]
    assert len(rows[0]["map_mass"]) == rows[0]["n_cells"]
    write_index(tmp_path / "index.html", again)
    page = (tmp_path / "index.html").read_text()
    assert "2 of 4 bags were identified, 2 failed." in page
    assert "noise.mcap" in page and "src=" not in page
    for outcome in again:
        if outcome["state"] == "done":
            assert f'href="{outcome["page_file"]}"' in page
            assert "mass and friction" in (tmp_path / outcome["page_file"]).read_text()

    fleet = CliRunner().invoke(app, ["fleet", str(bags / "monday" / "noise.mcap"), "--out", str(tmp_path), "--max-seconds", "5"])
    assert fleet.exit_code == 1 and "0 of 1 bags identified" in fleet.output
    assert read_table(tmp_path / "results.parquet")["state"].to_pylist() == ["failed"]
