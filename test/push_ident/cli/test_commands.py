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

CLI = [sys.executable, "-c", "from push_ident.cli.main import main; main()"]


def run(*args: object) -> subprocess.CompletedProcess[str]:
    """One command in a process of its own."""
    return subprocess.run([*CLI, *map(str, args)], capture_output=True, text=True, timeout=120)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "hammer"
    write_records(path, random_records(hammer(2), 6, 2))
    return path


def test_identify_writes_what_the_contract_names(bag: Path, tmp_path: Path) -> None:
    done = run("identify", bag, "--train", "0,1,2", "--json", tmp_path / "r.json", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["train"]["pushes"] == [0, 1, 2]
    assert content["test"]["pushes"] == [3, 4, 5]
    assert content["test"]["identified_m"] < content["test"]["uniform_m"]
    assert all(len(values) == content["n_cells"] for values in content["map"].values())
    assert content["total_mass"]["identifiable"] is False
    assert {"model.json", "report.html", "result.json"} == {p.name for p in (tmp_path / "out").iterdir()}
    predicted = run("predict", tmp_path / "out" / "model.json", bag, "--json", tmp_path / "p.json")
    assert predicted.returncode == 0, predicted.stderr
    assert json.loads((tmp_path / "p.json").read_text())["cell_error_m"] < 0.004


def test_identify_predicts_every_push_on_request(bag: Path, tmp_path: Path) -> None:
    done = run("identify", bag, "--train", "0,1", "--out", tmp_path, "--record")
    assert done.returncode == 0, done.stderr
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "Predictions before each push" in page and "hammer push 1</code>" in page and "hammer push 0" not in page


def _empty(path: Path, bag: Path) -> Path:
    path.mkdir()
    return path


def _missing(path: Path, bag: Path) -> Path:
    return path


def _random(path: Path, bag: Path) -> Path:
    file = path.with_suffix(".mcap")
    file.write_bytes(os.urandom(5000))
    return file


def _cut(path: Path, bag: Path) -> Path:
    """Half a bag, written in small chunks as a long recording is."""
    with BagWriter(path, chunk_size=4096) as writer:
        for message in raw_messages(bag):
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)
    file = next(path.glob("*.mcap"))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return path


def _no_pusher(path: Path, bag: Path) -> Path:
    record = random_records(hammer(2), 1, 2)[0]
    with BagWriter(path) as writer:
        writer.write_shape("1", record.shape, 1.0)
        for time, pose, covariance in zip(record.poses.time, record.poses.pose, record.poses.covariance, strict=True):
            writer.write_pose("1", 1.0 + float(time), pose, covariance)
    return path


@pytest.mark.parametrize(
    ("make", "says"),
    [(_empty, "holds no bag"), (_missing, "no such bag"), (_random, "cannot be read"), (_cut, "salvage"), (_no_pusher, "pusher/pose")],
    ids=["empty folder", "missing path", "random bytes", "cut in half", "no pusher poses"],
)
@pytest.mark.parametrize("command", ["identify", "replay"])
def test_bad_bag_ends_in_one_clear_line(make, says: str, command: str, bag: Path, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    done = run_here(command, make(tmp_path / "bad", bag))
    assert done.returncode not in (0, None)
    assert says in done.stderr
    assert "Traceback" not in done.stdout + done.stderr
    assert len(done.stderr.strip().splitlines()) == 1


def test_version_is_that_of_the_package() -> None:
    assert run_here("--version").stdout.split() == ["push-ident", __version__]


def test_refusal_of_a_process_has_its_exit_status_and_one_line(tmp_path: Path) -> None:
    done = run("identify", tmp_path / "absent")
    assert done.returncode == 1 and done.stdout.strip() == "" and len(done.stderr.strip().splitlines()) == 1


def test_train_numbers_out_of_range_are_refused(bag: Path) -> None:
    done = run_here("identify", bag, "--train", "0,17")
    assert done.returncode == 1
    assert "names push 17" in done.stderr


def test_bag_cut_in_half_can_be_salvaged_and_identified(bag: Path, tmp_path: Path) -> None:
    cut = _cut(tmp_path / "cut", bag)
    saved = run_here("salvage", cut, "--out", tmp_path / "saved")
    assert saved.returncode == 0, saved.stderr
    assert run_here("identify", tmp_path / "saved").returncode == 0


@pytest.mark.parametrize(("chosen", "used"), [({}, "1"), ({"OPENBLAS_NUM_THREADS": "3"}, "3")], ids=["by default", "as chosen"])
@pytest.mark.parametrize("module", ["push_ident.cli.entry", "push_ident.nodes.executables"])
def test_linear_algebra_has_one_thread_before_numpy_is_loaded(module: str, chosen: dict[str, str], used: str) -> None:
    program = f"import {module}, os, sys; assert 'numpy' not in sys.modules; print(os.environ['OPENBLAS_NUM_THREADS'])"
    environment = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"} | chosen
    done = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, timeout=60)
    assert done.stdout.strip() == used, done.stderr
