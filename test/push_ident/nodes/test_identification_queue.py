"""What waits for identification is counted by what it is: pushes, and better outlines."""

from __future__ import annotations

import threading
import time

import pytest
import rclpy
from rclpy.context import Context

from helpers.executor_cell import Stalls
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.identification import identification_node
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.nodes.identification.work import Kind, WorkQueue


def test_work_is_done_in_its_order_but_only_the_latest_outline_of_an_object() -> None:
    queue, done, left = WorkQueue(), [], []
    assert queue.first() is None
    for name, i in (("o1", 0), ("o1", 1), ("o1", 2), ("o2", 3), ("", 4), ("o2", 5), ("o2", 6)):
        queue.put(Kind.OUTLINE if name else Kind.PUSH, lambda i=i: done.append(i), instead_of=name)  # type: ignore[misc]
    while (work := queue.first()) is not None:
        work()
        left.append((queue.n_waiting(Kind.OUTLINE), queue.n_waiting(Kind.PUSH)))  # what is under way included
        queue.first_is_done()
    assert done == [0, 2, 3, 4, 6]  # the first one may have begun
    assert left == [(4, 1), (3, 1), (2, 1), (1, 1), (1, 0)] and queue.n_waiting(Kind.OUTLINE) == 0


@pytest.mark.live
def test_node_that_loads_its_kernels_is_closed_without_waiting_for_them(monkeypatch: pytest.MonkeyPatch) -> None:
    may_load, context = threading.Event(), Context()
    monkeypatch.setattr(identification_node, "compile_kernels", lambda **options: may_load.wait(60.0))
    rclpy.init(context=context, domain_id=own_domain())
    node = IdentificationNode(context=context)
    try:
        with Stalls() as stalls:
            asked = time.monotonic()
            node.close()
            took = time.monotonic() - asked
        assert took < 0.8 + 4.0 * stalls.worst
    finally:
        may_load.set()
        node.destroy_node()
        context.try_shutdown()
