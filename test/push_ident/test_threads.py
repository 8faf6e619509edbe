"""Parallel work within parallel work: its order, its number of threads, and its failures."""

from __future__ import annotations

import multiprocessing
import os
import time
from threading import Lock, get_ident

import pytest

from push_ident.threads import map_in_threads


def test_results_keep_their_order_whoever_is_first() -> None:
    assert map_in_threads(lambda k: (time.sleep(0.02 * (k == 0)), k)[1], range(6)) == list(range(6))
    assert map_in_threads(str, []) == []


@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="one processor has no helper")
def test_thread_without_work_helps_the_other_one_and_no_processor_has_two() -> None:
    lock, now, most = Lock(), 0, 0

    def work(_: object) -> int:
        nonlocal now, most
        with lock:
            now += 1
            most = max(most, now)
        time.sleep(0.01)
        with lock:
            now -= 1
        return get_ident()

    # As a fit that simulates its pushes again and again.
    short, long = map_in_threads(lambda n: [thread for _ in range(n) for thread in map_in_threads(work, range(4))], [1, 20])
    # The thread of the short task, or another one in its place, takes a part of the long one.
    assert len(short) == 4 and len(set(long)) >= 2
    assert 2 <= most <= min(4, len(os.sched_getaffinity(0)))


def test_failure_ends_the_work() -> None:
    done = []

    def fail(k: int) -> None:
        time.sleep(0.02 * (k != 1))
        done.append(k)
        assert k != 1, "the second one"

    with pytest.raises(AssertionError, match="the second one"):
        map_in_threads(fail, range(100))
    assert len(done) < 10


def test_forked_process_has_threads_of_its_own() -> None:
    map_in_threads(time.sleep, [0.01] * 4)
    child = multiprocessing.get_context("fork").Process(target=map_in_threads, args=(abs, [-1, -2, -3]))
    child.start()
    child.join(20.0)
    # Where it waits for threads that it does not have, it has no exit code yet.
    exit_code = child.exitcode
    child.kill()
    child.join()
    assert exit_code == 0
