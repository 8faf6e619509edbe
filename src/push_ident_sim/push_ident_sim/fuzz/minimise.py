"""The shortest sequence of messages that makes a node fail, and the fewest changed fields in them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final, TypeVar

from rclpy.serialization import deserialize_message, serialize_message

from push_ident_sim.fuzz.bench import Bench, NodeFailure, Sent
from push_ident_sim.fuzz.fields import get_at as value_at
from push_ident_sim.fuzz.fields import leaves, set_at
from push_ident_sim.fuzz.session import Finding, Session, scene_of

__all__ = ["minimise", "shortest"]

T = TypeVar("T")

_SUFFIXES: Final = (1, 12, 60, 400)
"""Numbers of latest messages that are tried first: most failures come at once."""


def shortest(items: Sequence[T], fails: Callable[[list[T]], bool]) -> list[T]:
    """A sequence that still fails, from which no single item can be left out.

    Delta debugging: Zeller & Hildebrandt, "Simplifying and Isolating Failure-Inducing Input" (2002), by complements.
    """
    found, n_parts = list(items), 2
    while len(found) >= 2:
        size = -(-len(found) // n_parts)
        for start in range(0, len(found), size):
            rest = found[:start] + found[start + size :]
            if rest and fails(rest):
                found, n_parts = rest, max(n_parts - 1, 2)
                break
        else:
            if n_parts >= len(found):
                break
            n_parts = min(2 * n_parts, len(found))
    return found


def minimise(finding: Finding, folder: Path, domain: int, *, seconds: float) -> list[Sent]:
    """Messages that make a fresh node fail in the same manner; empty when none of the sequences tried does, within `seconds`."""
    deadline = time.monotonic() + seconds
    tries = iter(range(10**6))

    def fails(messages: list[Sent]) -> bool:
        if time.monotonic() > deadline:
            return False
        return _failure_of(finding.node, folder / f"try{next(tries)}", domain, messages) == finding.kind

    for n in (*_SUFFIXES, len(finding.messages)):
        candidates = finding.messages[-n:]
        if fails(candidates):
            return _without_fields(shortest(candidates, fails), fails)
    return []


def _failure_of(node: str, folder: Path, domain: int, messages: list[Sent]) -> str:
    """Kind of the failure that the messages cause in a fresh node; empty when there is none."""
    session = Session(node, folder, domain, 0)
    kind = scene_of(node)
    session.folder.mkdir(parents=True, exist_ok=True)
    with Bench(node, session.folder, domain, kind.parameters(session.folder)) as bench:
        scene = kind(bench)
        try:
            session.begin(bench, scene)
            session.replay(bench, scene, messages)
            bench.check()
        except NodeFailure as failure:
            return failure.kind
    return ""


def _without_fields(messages: list[Sent], fails: Callable[[list[Sent]], bool]) -> list[Sent]:
    """The same with as many fields at their default as possible, for messages that can be read."""
    for i, sent in enumerate(messages):
        for simpler in _simpler(sent):
            changed = [*messages[:i], simpler, *messages[i + 1 :]]
            if fails(changed):
                messages = changed
                break
    return messages


def _simpler(sent: Sent) -> Iterator[Sent]:
    """The message with all fields but one of the first level at their default."""
    if sent.valid:
        return
    kind: Any = sent.kind.Request if sent.is_request else sent.kind
    try:
        msg = deserialize_message(sent.data, kind)
    except Exception:  # mutated bytes: what they hold is unknown, they stay as they are
        return
    for path, _ in leaves(kind()):
        if len(path) == 1:
            simple = kind()
            set_at(simple, path, value_at(msg, path))
            yield Sent(sent.to, sent.kind, serialize_message(simple), is_request=sent.is_request)
