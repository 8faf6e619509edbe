"""The fixture `trial` of a fault, and the results of all: `FAULTS=PATH.json` writes them, with a page beside."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from system.faults.process import set_priority
from system.faults.report import Results
from system.faults.suite import Cells, Trial, trial_of

PRIORITY = -15
"""Niceness of the cells and of what observes them."""
RESULTS = Results(Path(os.environ["FAULTS"]) if "FAULTS" in os.environ else None)


@pytest.fixture(scope="session")
def cells(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cells]:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    set_priority(os.getpid(), PRIORITY)
    cells = Cells(tmp_path_factory.mktemp("faults"))
    yield cells
    cells.close()
    set_priority(os.getpid(), before)


@pytest.fixture
def trial(request: pytest.FixtureRequest, cells: Cells) -> Iterator[Trial]:
    """Of the row that the test is marked with."""
    row = request.node.get_closest_marker("faults").args[0]
    with trial_of(row, cells) as trial:
        RESULTS.begin(trial)
        yield trial
    if RESULTS.failed(row):
        cells.close()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item, call: pytest.CallInfo[None]) -> Iterator[None]:
    report = yield
    if marker := item.get_closest_marker("faults"):
        RESULTS.take(marker.args[0], report, call)
    return report


def pytest_sessionfinish() -> None:
    RESULTS.write()
