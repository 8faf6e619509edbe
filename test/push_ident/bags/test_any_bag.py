"""Whatever a bag holds, it is read as what it promises or refused in one line; neither costs more time or memory than a bag may."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from helpers.bags import make_record
from helpers.commands import run_here
from helpers.fuzzing import fuzzed
from helpers.fuzzing.bags import bags, limit_memory, read_both_ways, write_mcap
from push_ident.bags.raw import RawMessage, raw_messages
from push_ident.bags.records import write_records
from push_ident.limits import LIMITS

LONGEST = 60.0
"""For a small bag [s]; it takes a tenth of a second, as others may share the machine."""


@pytest.fixture(scope="module")
def reader() -> Iterator[ProcessPoolExecutor]:
    with ProcessPoolExecutor(1, mp_context=get_context("spawn"), initializer=limit_memory) as pool:
        yield pool


SOUND: list[RawMessage] = []


@pytest.fixture(scope="module", autouse=True)
def sound(tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("sound") / "bag"
    write_records(path, [make_record(1.0), make_record(5.0)])
    SOUND.extend(raw_messages(path))


def with_a_name_that_is_no_text(folder: Path) -> None:
    write_mcap(folder, SOUND)
    (file,) = folder.glob("*.mcap")
    file.write_bytes(file.read_bytes().replace(b"/pusher/pose", b"/pusher/\xff\xfe\xfd\xfc"))


def with_more_topics_than_can_be_read(folder: Path) -> None:
    write_mcap(folder, [replace(SOUND[0], topic=f"/x{number}") for number in range(LIMITS.TOPICS.value + 1)])


@pytest.mark.fuzz
@fuzzed(15, shrink=False)
@example(with_a_name_that_is_no_text)
@example(with_more_topics_than_can_be_read)
@given(st.deferred(lambda: bags(SOUND)))
def test_any_bag_is_read_or_refused(
    reader: ProcessPoolExecutor, tmp_path_factory: pytest.TempPathFactory, write: Callable[[Path], None]
) -> None:
    folder = tmp_path_factory.mktemp("any_bag")
    try:
        write(folder / "bag")
        refused = reader.submit(read_both_ways, folder / "bag", folder / "salvaged").result(LONGEST)
        assert all("\n" not in text and len(text) < 2000 for text in refused), refused
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture(scope="module")
def model(reader: ProcessPoolExecutor, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the object of the sound bag."""
    folder = tmp_path_factory.mktemp("model")
    write_mcap(folder / "bag", SOUND)
    reader.submit(run_here, "identify", folder / "bag", "--out", folder).result(LONGEST)
    return folder / "model.json"


@pytest.mark.long
@pytest.mark.fuzz
@fuzzed(8, shrink=False)
@given(st.deferred(lambda: bags(SOUND)), st.sampled_from(["identify", "diagnose", "predict", "view"]))
def test_any_bag_is_answered_or_refused_in_one_line(
    reader: ProcessPoolExecutor, model: Path, tmp_path_factory: pytest.TempPathFactory, write: Callable[[Path], None], command: str
) -> None:
    folder = tmp_path_factory.mktemp("any_bag")
    try:
        write(folder / "bag")
        out = ["--out", folder / "view.rrd"] if command == "view" else []
        done = reader.submit(run_here, command, *([model] if command == "predict" else []), folder / "bag", *out).result(LONGEST)
        refused = [line for line in done.stderr.splitlines() if line.startswith("push-ident: ")]
        assert done.returncode in (0, 1) and len(refused) == done.returncode and "Traceback" not in done.stderr, done.stderr
    finally:
        shutil.rmtree(folder, ignore_errors=True)
