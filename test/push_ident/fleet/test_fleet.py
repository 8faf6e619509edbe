"""Many bags through Ray: real workers, real bags, real Parquet."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from pyarrow.parquet import read_table

from helpers.bags import copy_renamed
from helpers.commands import run_here
from helpers.objects import hammer, random_records
from push_ident.bags.records import write_records
from push_ident.errors import InputError
from push_ident.fleet import FleetOptions, find_jobs, run_fleet, write_index, write_table
from push_ident.fleet.job import Outcome
from push_ident.identification.results.model_file import load_model

pytestmark = pytest.mark.alone

OPTIONS = FleetOptions(max_seconds=5.0)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag that can be identified, deep in folders, and one that cannot."""
    folder = tmp_path_factory.mktemp("bags")
    (folder / "monday").mkdir()
    write_records(folder / "tuesday" / "shift2" / "a", random_records(hammer(2), 5, 2))
    (folder / "monday" / "noise.mcap").write_bytes(bytes(range(256)) * 20)
    return folder


def test_finds_bags_at_any_depth_once_and_knows_them_again(bags: Path) -> None:
    jobs = find_jobs([bags, bags / "monday"], OPTIONS)
    assert [job.bag.name for job in jobs] == ["noise.mcap", "a"]
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

    outcomes = run_fleet(jobs, OPTIONS, tmp_path, workers=1, on_outcome=see)
    failed, done = outcomes
    assert (failed["state"], done["state"]) == ("failed", "done") and failed["error"]
    assert places == {1.0} and os.getpid() not in {o["process"] for o in outcomes}
    assert sorted(o["bag"] for o in seen) == sorted(str(job.bag) for job in jobs)
    assert done["result"]["test"]["pushes"] == [3]
    object_id, posterior = load_model(tmp_path / done["model_file"])
    assert object_id == done["result"]["object_id"]
    assert posterior.model.mass.tolist() == pytest.approx(done["result"]["map"]["mass"])
    before = {p: p.stat().st_mtime_ns for p in (tmp_path / "bags").iterdir()}
    again = run_fleet(jobs, OPTIONS, tmp_path, workers=1)
    assert again == json.loads(json.dumps(outcomes))
    assert {p: p.stat().st_mtime_ns for p in (tmp_path / "bags").iterdir()} == before

    write_table(tmp_path / "results.parquet", again)
    rows = read_table(tmp_path / "results.parquet").to_pylist()
    assert [row["state"] for row in rows] == ["failed", "done"]
    assert rows[1]["test_identified_m"] == again[1]["result"]["test"]["identified_m"]
    assert len(rows[1]["map_mass"]) == rows[1]["n_cells"]
    write_index(tmp_path / "index.html", again)
    page = (tmp_path / "index.html").read_text()
    assert "1 of 2 bags were identified, 1 failed." in page and "noise.mcap" in page and "src=" not in page
    assert f'href="{done["page_file"]}"' in page and "mass and friction" in (tmp_path / done["page_file"]).read_text()

    fleet = run_here("fleet", bags / "monday", "--out", tmp_path, "--max-seconds", 5)
    assert fleet.returncode == 1 and "0 of 1 bags identified" in fleet.stdout + fleet.stderr
    assert read_table(tmp_path / "results.parquet")["state"].to_pylist() == ["failed"]


def test_bags_with_topics_of_other_names_are_mapped_and_known_by_the_map(bags: Path, tmp_path: Path) -> None:
    names = {"/objects/1/pose": "/body", "/pusher/pose": "/tool"}
    copy_renamed(bags / "tuesday" / "shift2" / "a", tmp_path / "foreign", names)
    maps = ("--map", "/body=pose:1", "--map", "/tool=pusher")
    for options, count in (((), "0 of 1"), (maps, "1 of 1")):
        done = run_here("fleet", tmp_path / "foreign", "--out", tmp_path / "out", "--max-seconds", 5, "--no-pages", *options)
        assert f"{count} bags identified" in done.stdout + done.stderr, done.stdout + done.stderr
