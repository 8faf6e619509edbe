"""What a full queue drops is counted, and a stage that is slower than its input says so."""

from __future__ import annotations

import time
from functools import partial

import pytest
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String

from helpers.node_process import Talker
from helpers.spinning import BareNode, running
from push_ident.errors import InputError
from push_ident.nodes.base.arrivals import Arrivals, StampCheck
from push_ident.nodes.base.cell_node import CellNode
from push_ident.nodes.base.network import own_domain


@pytest.mark.parametrize(
    ("numbers", "n_publishers", "n_lost"),
    [((7, 8, 11, 12), 1, 2), ((500, 501, 1, 2), 1, 0), ((1, 900, 2, 901), 2, 0), ((None, None), 1, 0)],
    ids=["gap", "new publisher", "two publishers", "without numbers"],
)
def test_gaps_of_the_numbers_of_one_publisher_are_messages_that_were_lost(numbers: tuple[int, ...], n_publishers: int, n_lost: int) -> None:
    arrivals = Arrivals(lambda: n_publishers)
    for number in numbers:
        arrivals.note({"publication_sequence_number": number, "source_timestamp": time.time_ns() - 200_000_000})
    lost, taken, delay = arrivals.since_last()
    assert (lost, taken) == (n_lost, len(numbers)) == (arrivals.n_lost, arrivals.n_taken) and 0.19 < delay < 1.0
    assert arrivals.since_last() == (0, 0, 0.0)


def test_wrong_stamp_is_refused_until_others_agree_on_its_time() -> None:
    check, refused = StampCheck(), []
    check.check("pusher", 98.0)
    for stamp in (100.0, 1e9, 100.03, 0.0, 100.06, 5.0, 5.03, 5.06):
        try:
            check.check("pose", stamp)
        except InputError as error:
            assert "from those of other messages" in str(error)
            refused.append(stamp)
    assert refused == [1e9, 0.0, 5.0, 5.03]
    check.check("pusher", 98.1)  # what was still waiting from before
    check.check("pusher", 5.0)


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
