"""The fast part of the fault suite: live nodes in one cell, a fault from outside, the oracles after each."""

from __future__ import annotations

import pytest

from push_ident_sim.faults.registry import FAULTS
from push_ident_sim.faults.run import FaultResult, run_faults

pytestmark = pytest.mark.alone

FAST = [fault for fault in FAULTS if fault.fast]
ALWAYS = ("executor-killed", "impossible-requests")
"""One that a node does not survive and one that it refuses; the tests of each node have the others without a simulated cell."""


@pytest.fixture(scope="module")
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, FaultResult]:
    """Of the faults that this run of the tests asks for, tried one after the other in one cell."""
    items = [item for item in request.session.items if item.path == request.path and isinstance(item, pytest.Function)]
    asked = {item.callspec.params["name"] for item in items if hasattr(item, "callspec")}
    chosen = [fault for fault in FAST if fault.name in asked]
    found = run_faults(chosen, tmp_path_factory.mktemp("faults"), on_result=lambda result: None)
    return {result.fault.name: result for result in found}


@pytest.mark.parametrize("name", [pytest.param(f.name, marks=() if f.name in ALWAYS else pytest.mark.long) for f in FAST])
def test_fault_is_held(name: str, results: dict[str, FaultResult]) -> None:
    result = results[name]
    if result.impossible:
        pytest.skip(result.impossible)
    assert not result.failures


def test_every_row_of_the_list_of_faults_has_an_entry() -> None:
    assert {fault.number for fault in FAULTS} >= set(range(1, 34))
