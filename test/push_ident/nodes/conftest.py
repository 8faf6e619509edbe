"""What the tests of a module share: a ROS domain, and a cell on it that the test plays."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context

from helpers.executor_cell import Cell
from helpers.spinning import spinning
from push_ident.nodes.base.network import own_domain


@pytest.fixture(scope="module")
def domain() -> int:
    return own_domain()


@pytest.fixture(scope="module")
def context(domain: int) -> Iterator[Context]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    yield context
    context.try_shutdown()


@pytest.fixture(scope="module")
def the_cell(domain: int) -> Iterator[Cell]:
    with spinning(Cell, domain) as cell:
        yield cell
