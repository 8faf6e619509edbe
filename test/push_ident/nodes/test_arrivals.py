"""What a full queue drops is counted, and a stage that is slower than its input says so."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

import pytest
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String

from helpers.node_process import Talker
from helpers.spinning import BareNode, running
from push_ident.nodes.base.arrivals import Arrivals
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.network import own_domain


def info(number: int | None, age: float = 0.0) -> dict[str, Any]:
    return {"publication_sequence_number": number, "source_timestamp": time.time_ns() - round(1e9 * age)}


def test_gaps_of_the_numbers_are_messages_that_were_lost() -> None:
    arrivals = Arrivals(lambda: 1)
    for number in (7, 8, 11, 12):
        arrivals.note(info(number, age=0.2))
    lost, taken, delay = arrivals.since_last()
    assert (lost, taken) == (2, 4)
    assert 0.19 < delay < 1.0
    assert arrivals.since_last() == (0, 0, 0.0)
    assert arrivals.n_lost == 2


@pytest.mark.parametrize(("numbers", "n_publishers"), [((500, 501, 1, 2), 1), ((1, 900, 2, 901), 2), ((None, None), 1)])
def test_no_loss_is_known_of_a_new_publisher_of_several_and_without_numbers(numbers: tuple[int, ...], n_publishers: int) -> None:
    arrivals = Arrivals(lambda: n_publishers)
    for number in numbers:
        arrivals.note(info(number))
    assert arrivals.n_lost == 0 and arrivals.n_taken == len(numbers)


@pytest.mark.live
def test_node_counts_what_its_queue_drops() -> None:
    domain, found = own_domain(), list[Arrivals]()

    def listen(node: CellNode) -> None:
        found.append(node.arrivals_of("words"))
        node.create_subscription(String, "words", lambda msg: time.sleep(0.03), qos_profile_sensor_data, arrivals=found[0])

    with running(partial(BareNode, listen), domain), Talker(domain) as talker:
        (arrivals,) = found
        words = talker.node.create_publisher(String, "words", qos_profile_sensor_data)
        talker.until(words.get_subscription_count)
        talker.until(lambda: arrivals.n_taken, lambda: words.publish(String(data="first")))
        before = arrivals.n_taken + arrivals.n_lost
        for _ in range(100):
            words.publish(String(data="more"))
        talker.until(lambda: arrivals.n_taken + arrivals.n_lost >= before + 100)
        assert arrivals.n_lost > 50  # the queue holds five
