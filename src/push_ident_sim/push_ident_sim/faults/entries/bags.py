"""Faults of recordings, through the commands that read them."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any, Final

import numpy as np

from push_ident.bags.raw import RawMessage, raw_messages
from push_ident.bags.typestore import jazzy_typestore
from push_ident.bags.writer import BagWriter
from push_ident_sim.faults.fault import Fault, Trial
from push_ident_sim.faults.harness.command import Ended, run_command
from push_ident_sim.faults.harness.process import TRACEBACK

__all__ = ["FAULTS"]

_TIME, _MEMORY = 10.0, 1000.0
"""Most that a bag of up to 100 MB may take, whatever it claims [s], [MB]."""
_N_FLIPS: Final = 6
_TOLERATED: Final = 0.01
"""Mean error on its own training pushes with which a fit may be called a success [m]: ten times the noise of the poses."""
_LONE: Final = "push_ident_faults/msg/Unknown"


def _good_bag(trial: Trial) -> Path:
    """Four simulated pushes of a hammer; made once for all faults."""
    bag = trial.folder.parent / "good_bag"
    if not bag.exists():
        done = run_command(trial.folder, "simulate", "--pushes", 4, "--out", bag)
        trial.expect(done.code == 0, f"the bag was not made: {done.output[-200:]}")
    return bag


def _rewritten(bag: Path, out: Path, change: Callable[[RawMessage], RawMessage | None], **options: Any) -> Path:
    """The bag with every message changed, or left out."""
    with BagWriter(out, chunk_size=4096) as writer:
        for message in raw_messages(bag):
            new = change(message)
            if new is not None:
                writer.write_raw(new.topic, new.msgtype, new.stamp_ns, new.data, **(options if new.msgtype == _LONE else {}))
    return out


def _changed(message: RawMessage, change: Callable[[Any], None]) -> RawMessage:
    store = jazzy_typestore()
    content = store.deserialize_cdr(message.data, message.msgtype)
    change(content)
    data = bytes(store.serialize_cdr(content, message.msgtype))
    return RawMessage(message.topic, message.msgtype, message.stamp_ns, data)


def _refused(trial: Trial, done: Ended, *words: str) -> None:
    trial.expect(done.is_refusal, f"it ended with {done.code} and {len(done.error.strip().splitlines())} lines: {done.error[-200:]}")
    trial.expect(all(word in done.error for word in words), f"it does not name {', '.join(words)}: {done.error[-200:]}")
    _bounded(trial, done)
    trial.note = done.error.strip().replace(str(trial.folder), "")[-150:]


def _bounded(trial: Trial, done: Ended) -> None:
    trial.expect(done.seconds < _TIME, f"it took {done.seconds:.0f} s of the processor, limit {_TIME:.0f} s")
    trial.expect(done.megabytes < _MEMORY, f"it took {done.megabytes:.0f} MB, limit {_MEMORY:.0f} MB")


def _damaged(trial: Trial) -> None:
    """A bag that was cut, and bags with one flipped bit each."""
    bag = _rewritten(_good_bag(trial), trial.folder / "chunks", lambda message: message)
    file = next(bag.glob("*.mcap"))
    whole = file.read_bytes()
    cut = trial.folder / "cut.mcap"
    cut.write_bytes(whole[: len(whole) * 6 // 10])
    _refused(trial, run_command(trial.folder, "identify", cut), "salvage")
    salvaged = run_command(trial.folder, "salvage", cut, "--out", trial.folder / "salvaged")
    trial.expect(salvaged.code == 0 and "messages recovered" in salvaged.output, f"nothing was salvaged: {salvaged.output[-200:]}")
    again = run_command(trial.folder, "identify", trial.folder / "salvaged")
    trial.expect(again.code == 0, f"the salvaged bag is not identified: {again.error[-200:]}")
    rng, outcomes = np.random.default_rng(0), []
    for number in range(_N_FLIPS):
        flipped = bytearray(whole)
        flipped[int(rng.integers(len(whole)))] ^= 1 << int(rng.integers(8))
        path = trial.folder / f"flipped-{number}.mcap"
        path.write_bytes(flipped)
        done = run_command(trial.folder, "identify", path)
        trial.expect(done.code == 0 or done.is_refusal, f"{path.name}: ended with {done.code}: {done.error[-200:]}")
        _bounded(trial, done)
        outcomes.append(done.code)
    trial.note = f"salvaged and identified; of {_N_FLIPS} bags with a flipped bit {outcomes.count(0)} were read, the others refused"
    trial.lost = "what was behind the cut"


def _without_topic(trial: Trial) -> None:
    bag = _rewritten(_good_bag(trial), trial.folder / "bag", lambda m: None if m.topic.endswith("pusher/pose") else m)
    _refused(trial, run_command(trial.folder, "identify", bag), "pusher/pose", "objects/")


def _other_types(trial: Trial) -> None:
    bag = _good_bag(trial)

    def retyped(msgtype: str) -> Callable[[RawMessage], RawMessage]:
        return lambda m: RawMessage(m.topic, msgtype if m.topic.endswith("pusher/pose") else m.msgtype, m.stamp_ns, m.data)

    text = _rewritten(bag, trial.folder / "text", retyped("std_msgs/msg/String"))
    _refused(trial, run_command(trial.folder, "identify", text), "pusher/pose")
    unknown = _rewritten(bag, trial.folder / "unknown", retyped(_LONE), definition=("ros2msg", b"float64 x\nfloat64 y"))
    _refused(trial, run_command(trial.folder, "identify", unknown), "pusher/pose")


def _malicious(trial: Trial) -> None:
    """Bytes that are no bag, a model that is a pickle, markup in names."""
    noise = trial.folder / "noise.mcap"
    noise.write_bytes(np.random.default_rng(0).bytes(200_000))
    _refused(trial, run_command(trial.folder, "identify", noise))
    bag = _good_bag(trial)
    odd = trial.folder / "[red]x <b>&"
    os.rename(_rewritten(bag, trial.folder / "odd", lambda m: m), odd)
    out = trial.folder / "out"
    done = run_command(trial.folder, "identify", odd, "--out", out)
    trial.expect(done.code == 0 and TRACEBACK not in done.output, f"markup in a name: ended with {done.code}: {done.error[-200:]}")
    pages = "".join(path.read_text(encoding="utf-8") for path in out.rglob("*.html"))
    trial.expect("x <b>&" not in pages, "the name of a bag stands in a page as markup")
    trial.note = "noise refused; names are only text"


def _huge_claims(trial: Trial) -> None:
    """A grid that claims ten thousand million cells, and one that has fifty million."""
    bag, worst = _good_bag(trial), 0.0
    for name, edge, n in (("claims", 100_000, 100), ("has", 7000, 49_000_000)):

        def huge(message: RawMessage, edge: int = edge, n: int = n) -> RawMessage:
            if not message.topic.endswith("/cells"):
                return message

            def grow(grid: Any) -> None:
                grid.info.width = grid.info.height = edge
                grid.data = np.full(n, 100, dtype=np.int8)

            return _changed(message, grow)

        done = run_command(trial.folder, "identify", _rewritten(bag, trial.folder / name, huge))
        _refused(trial, done, "cells")
        worst = max(worst, done.megabytes)
    trial.note = f"refused; {worst:.0f} MB at most"


def _unexplained(trial: Trial) -> None:
    """An outline of another size than the object: no map explains the pushes."""
    for name, factor in (("half", 0.5), ("threefold", 3.0)):

        def scaled(message: RawMessage, factor: float = factor) -> RawMessage:
            if not message.topic.endswith("/outline"):
                return message

            def scale(outline: Any) -> None:
                for point in outline.polygon.points:
                    point.x, point.y = factor * point.x, factor * point.y

            return _changed(message, scale)

        file = trial.folder / f"{name}.json"
        done = run_command(trial.folder, "identify", _rewritten(_good_bag(trial), trial.folder / name, scaled), "--json", file)
        trial.expect(TRACEBACK not in done.output, "a traceback")
        content = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
        status, error = content.get("status", "refused"), (content.get("train") or {}).get("identified_m") or 0.0
        success = done.code == 0 and status == "converged"
        trial.expect(not (success and error > _TOLERATED), f"outline scaled by {factor}: {status} with {1e3 * error:.0f} mm, exit 0")
        trial.note += f"outline × {factor:g}: {status}, exit {done.code}. "


FAULTS: Final = (
    Fault(
        number=10,
        name="damaged-bag",
        what=f"a bag cut at 60 %; {_N_FLIPS} bags with a flipped bit",
        holds="the reader of bags; salvage",
        expected="one line and a remedy; a new bag with what is readable",
        run=_damaged,
    ),
    Fault(
        number=11,
        name="missing-topic",
        what="a bag without pusher/pose",
        holds="the reader of bags",
        expected="names what is missing and present; exit not 0",
        run=_without_topic,
    ),
    Fault(
        number=12,
        name="other-types",
        what="a topic of another type, and of an unknown one",
        holds="the schema of the bag",
        expected="one line that names the topic",
        run=_other_types,
    ),
    Fault(
        number=56,
        name="no-bag",
        what="random bytes as a bag; markup in its name",
        holds="the reader of bags; text from outside is only text",
        expected="one line; no markup in pages",
        run=_malicious,
    ),
    Fault(
        number=57,
        name="huge-claims",
        what="cells that claim 10^10 entries; 49 million cells",
        holds="limits of what is taken from outside",
        expected=f"refused within {_TIME:.0f} s and {_MEMORY / 1e3:.0f} GB",
        run=_huge_claims,
    ),
    Fault(
        number=32,
        name="unexplained-pushes",
        what="an outline of half and of three times the size",
        holds="the status of a fit",
        expected="no success: status and exit status say so",
        run=_unexplained,
    ),
)
