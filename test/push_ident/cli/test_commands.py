"""The command line as its users and their scripts see it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.commands import run_here
from helpers.objects import hammer, random_records
from push_ident import __version__
from push_ident.bags.raw import raw_messages
from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "hammer"
    write_records(path, random_records(hammer(2), 6, 2))
    return path


def test_identify_writes_what_the_contract_names_and_predicts_pushes_on_request(bag: Path, tmp_path: Path) -> None:
    done = run_here("identify", bag, "--train", "0,1", "--record", "--json", tmp_path / "r.json", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["train"]["pushes"] == [0, 1] and content["test"]["pushes"] == [2, 3, 4, 5]
    assert content["test"]["identified_m"] < content["test"]["uniform_m"]
    assert all(len(values) == content["n_cells"] for values in content["map"].values())
    assert content["total_mass"]["identifiable"] is False
    assert {"model.json", "report.html", "result.json"} == {p.name for p in (tmp_path / "out").iterdir()}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Predictions before each push" in page and "hammer push 1</code>" in page and "hammer push 0" not in page
    predicted = run_here("predict", tmp_path / "out" / "model.json", bag, "--json", tmp_path / "p.json")
    assert predicted.returncode == 0, predicted.stderr
    assert json.loads((tmp_path / "p.json").read_text())["cell_error_m"] < 0.004


@pytest.fixture
def cut(bag: Path, tmp_path: Path) -> Path:
    """Half a bag, written in small chunks as a long recording is."""
    path = tmp_path / "cut"
    with BagWriter(path, chunk_size=4096) as writer:
        for message in raw_messages(bag):
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)
    file = next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return path


def test_bag_cut_in_half_can_be_salvaged_and_identified(cut: Path, tmp_path: Path) -> None:
    saved = run_here("salvage", cut, "--out", tmp_path / "saved")
    assert saved.returncode == 0, saved.stderr
    assert run_here("identify", tmp_path / "saved").returncode == 0


def test_what_cannot_be_done_ends_in_one_line(bag: Path, cut: Path, tmp_path: Path) -> None:
    for command, reason in (
        (("identify", cut), "salvage"),
        (("replay", cut), "salvage"),
        (("diagnose", tmp_path / "absent"), "no such bag"),
        (("identify", bag, "--train", "0,17"), "names push 17"),
    ):
        done = run_here(*command)
        assert done.returncode == 1 and reason in done.stderr and "Traceback" not in done.stdout + done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_version_is_that_of_the_package() -> None:
    assert run_here("--version").stdout.split() == ["push-ident", __version__]


@pytest.mark.parametrize(
    ("module", "chosen", "used"),
    [
        ("push_ident.cli.entry", {}, "1"),
        ("push_ident.nodes.executables", {}, "1"),
        ("push_ident.cli.entry", {"OPENBLAS_NUM_THREADS": "3"}, "3"),
    ],
)
def test_linear_algebra_has_one_thread_before_numpy_is_loaded(module: str, chosen: dict[str, str], used: str) -> None:
    program = f"import {module}, os, sys; assert 'numpy' not in sys.modules; print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"} | chosen
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == used, done.stderr
