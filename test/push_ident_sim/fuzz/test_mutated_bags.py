"""Mutated bags through every command: the failures of former runs, and a few new ones."""

from __future__ import annotations

from pathlib import Path

import pytest

from push_ident_sim.fuzz.bags import failures_of, read_recipe
from push_ident_sim.fuzz.mutate_bag import draw

CASES = sorted((Path(__file__).parent / "bag_cases").glob("*.json"))


@pytest.mark.long
def test_failures_that_were_found_do_not_return_and_a_sample_of_mutants_is_survived() -> None:
    sample = [("identify", recipe) for recipe in (draw(3, number) for number in range(60)) if recipe.source in ("mcap", "sqlite3")]
    assert CASES
    assert failures_of([*(read_recipe(path) for path in CASES), *sample[:6]]) == []
