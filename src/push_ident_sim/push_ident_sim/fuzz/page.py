"""The page of the results of fuzzing, and its numbers as JSON beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

from push_ident.files import write_whole
from push_ident_sim.studies.common.files import read_json, write_json

__all__ = ["write_page"]

_KINDS: Final = ("messages", "bags", "frames")
_HEAD: Final = """# Fuzzing

Made by `make fuzz` (`push-ident fuzz --page {page}`). `--only messages`, `--only bags` or `--only frames` replaces one part of the
page. A failure is minimised, stored in `test/push_ident_sim/fuzz/cases`, and tried again by the tests.
"""

_MESSAGES: Final = """## Messages

Every node runs as a process of its own with valid traffic around it. In between come messages with mutated fields or bytes on every
topic it subscribes to, and mutated requests to every service it offers, those of actions, parameters and lifecycle included. After each
batch the node must answer a question; after each 400 messages it must do its work: learn a valid push, give a pose, push without a
command beyond the limits.

Seed {seed}, {minutes:.0f} minutes, load of the machine {load}: **{mutated:,} mutated messages, {failures} failures.**
"""

_BAGS: Final = """## Bags

Bags of every format that can be read, with mutated messages, records, containers and bytes, go through every command that reads one. A
failure is a traceback, more than 10 s of the processor, more than 1 GB of memory, a refusal without a reason, or a success with a
number that is not finite, a negative cell, or a fit that is said to have converged and misses its own pushes by more than 5 cm.

Seed {seed}, load of the machine {load}: **{mutants:,} mutated bags, {runs:,} runs of commands, {failures} failures.**
"""

_FRAMES: Final = """## Depth frames

Depth images of objects on a table, rendered for every sensor of the simulated cell, and recorded ones where they are on the machine, are
mutated and given to perception in sequences: before, during and after an object is taken in. Nothing but a refusal of the frame may leave
perception, within 1 s of the processor for 640 x 480 pixels; poses are finite with positive definite covariances, outlines do not cross
themselves. After each sequence come clean frames, which must be taken: the table within 4 mm of its place and, in images of 320 pixels and
more, the objects found again within 20 mm.

Seed {seed}, load of the machine {load}: **{frames:,} mutated frames in {sequences:,} sequences, {failures} failures.** Taken {taken:,},
refused {refused:,}; the slowest frame took {worst_seconds:.2f} s.
"""


def write_page(path: Path, content: dict[str, Any]) -> None:
    """Write the page. `content` has the results of some of the kinds; what it lacks is taken from the JSON beside the page."""
    numbers = path.with_suffix(".json")
    known: dict[str, Any] = (read_json(numbers) if numbers.exists() else {}) | {k: content[k] for k in _KINDS if k in content}
    parts = [_HEAD.format(page=path)]
    if "messages" in known:
        parts += _messages(known["messages"])
    if "bags" in known:
        parts += _bags(known["bags"])
    if "frames" in known:
        parts += _frames(known["frames"])
    write_json(numbers, known)
    write_whole(path, "\n".join(parts) + "\n", "the page")


def _messages(content: dict[str, Any]) -> list[str]:
    lines = [
        _MESSAGES.format(**content | {"failures": len(content["findings"])}),
        "| node | mutated | of them requests | valid between | refused | worked | longest answer [s] | memory [MB] | failures |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for node in content["nodes"]:
        requests = sum(node["services"].values())
        lines.append(
            f"| `{node['node']}` | {node['mutated']} | {requests} | {node['valid']} | {node['refused']} | {node['works']} times | "
            f"{node['worst_answer']:.2f} | {node['memory_growth']:+.0f} | {len(node['failures'])} |"
        )
    lines += ["", "### By topic", "", "| node | topic | mutated messages |", "|---|---|---|"]
    lines += [f"| `{node['node']}` | `{topic}` | {n} |" for node in content["nodes"] for topic, n in node["topics"].items()]
    return [*lines, ""]


def _bags(content: dict[str, Any]) -> list[str]:
    verdicts = {command: found for command, found in content["verdicts"].items() if command != "make"}
    runs = sum(sum(found.values()) for found in verdicts.values())
    lines = [
        _BAGS.format(**content | {"failures": len(content["findings"]), "runs": runs}),
        "| command | runs | refused | succeeded | failures | longest [s of the processor] | most memory [MB] |",
        "|---|---|---|---|---|---|---|",
    ]
    for command, found in sorted(verdicts.items()):
        n, refused, succeeded = sum(found.values()), found.get("refused", 0), found.get("succeeded", 0)
        lines.append(
            f"| `{command}` | {n} | {refused} | {succeeded} | {n - refused - succeeded} | {content['worst_seconds'][command]:.1f} | "
            f"{content['worst_memory'][command] / 1e3:.0f} |"
        )
    lines += ["", "| source | mutated bags |", "|---|---|", *(f"| {name} | {n} |" for name, n in sorted(content["by_source"].items()))]
    lines += ["", "| mutation | times |", "|---|---|", *(f"| {name} | {n} |" for name, n in sorted(content["by_mutation"].items()))]
    return [*lines, ""]


def _frames(content: dict[str, Any]) -> list[str]:
    taken = content["verdicts"].get("taken", 0)
    refused = {kind: n for kind, n in sorted(content["verdicts"].items()) if kind not in ("taken", "failed")}
    counts = {"failures": len(content["findings"]), "taken": taken, "refused": sum(refused.values())}
    tables = {
        "refused with": refused,
        "scene": content["by_scene"],
        "width of the image [px]": content["by_width"],
        "mutation": dict(sorted(content["by_mutation"].items())),
    }
    lines = [_FRAMES.format(**content | counts)]
    for head, numbers in tables.items():
        lines += [f"| {head} | mutated frames |", "|---|---|", *(f"| {name} | {n} |" for name, n in numbers.items()), ""]
    return lines
