"""The fast part of the fault suite: live nodes in one cell, a fault from outside, the oracles after each."""

from __future__ import annotations

import pytest

from push_ident_sim.faults.registry import FAULTS
from push_ident_sim.faults.run import FaultResult, run_faults

pytestmark = pytest.mark.alone

FAST = [fault for fault in FAULTS if fault.fast]


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, FaultResult]:
    found = run_faults(FAST, tmp_path_factory.mktemp("faults"), on_result=lambda result: None)
    return {result.fault.name: result for result in found}


@pytest.mark.parametrize("name", [fault.name for fault in FAST])
def test_fault_is_held(name: str, results: dict[str, FaultResult]) -> None:
    result = results[name]
    if result.impossible:
        pytest.skip(result.impossible)
    assert not result.failures


def test_every_row_of_the_list_of_faults_has_an_entry() -> None:
    assert {fault.number for fault in FAULTS} >= set(range(1, 34))
