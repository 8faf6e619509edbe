"""Pauses before a process is started again."""

from __future__ import annotations

from push_ident.cli.restart import Backoff, RestartPolicy


def test_pause_doubles_with_each_early_death_up_to_its_limit_and_then_there_is_none() -> None:
    backoff = Backoff(RestartPolicy(first=1.0, longest=30.0, settled=60.0, attempts=7))
    assert [backoff.pause(0.5) for _ in range(8)] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0, None]


def test_a_long_life_begins_the_count_anew() -> None:
    backoff = Backoff(RestartPolicy(first=1.0, longest=30.0, settled=60.0, attempts=2))
    assert [backoff.pause(lived) for lived in (0.5, 59.0, 60.0, 0.5, 0.5)] == [1.0, 2.0, 1.0, 2.0, None]
