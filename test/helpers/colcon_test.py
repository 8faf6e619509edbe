"""`colcon test` runs pytest in the folder of a package: which of test/ is its part."""

from __future__ import annotations

import os

import pytest

from helpers.paths import ROOT


def pytest_configure(config: pytest.Config) -> None:
    """Run the tests of the package, without those that `make test` leaves out, where nothing else is asked."""
    # Its arguments, the result file among them, are not those of a pytest that a test starts.
    os.environ.pop("PYTEST_ADDOPTS", None)
    folder = config.invocation_params.dir
    if not config.invocation_params.args and folder.parent == ROOT / "src":
        config.args[:] = [str(ROOT / "test" / folder.name)]
        config.option.markexpr = config.option.markexpr or "not long and not release and not faults"
