"""The page of the results of fuzzing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from push_ident.files import write_whole

__all__ = ["write_page"]


def write_page(path: Path, content: dict[str, Any]) -> None:
    """Write counts by node and topic, findings and how to do it again."""
    lines = [
        "# Fuzzing",
        "",
        "Made by `make fuzz`, which runs `push-ident fuzz`. Every node runs as a process of its own with valid traffic around it. In",
        "between come messages with mutated fields or bytes on every topic it subscribes to, and mutated requests to every service it",
        "offers, those of actions, parameters and lifecycle included. After each batch the node must answer a question; after each 400",
        "messages it must do its work: learn a valid push, give a pose, push without a command beyond the limits.",
        "",
        f"Seed {content['seed']}, {content['minutes']} minutes, load of the machine {content['load']}: "
        f"**{content['mutated']} mutated messages, {len(content['findings'])} failures.**",
        "",
        "| node | mutated | of them requests | valid between | refused | worked | longest answer [s] | memory [MB] | failures |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for node in content["nodes"]:
        requests = sum(node["services"].values())
        lines.append(
            f"| `{node['node']}` | {node['mutated']} | {requests} | {node['valid']} | {node['refused']} | {node['works']} times | "
            f"{node['worst_answer']:.2f} | {node['memory_growth']:+.0f} | {len(node['failures'])} |"
        )
    lines += ["", "## By topic", "", "| node | topic | mutated messages |", "|---|---|---|"]
    lines += [f"| `{node['node']}` | `{topic}` | {n} |" for node in content["nodes"] for topic, n in node["topics"].items()]
    write_whole(path, "\n".join(lines) + "\n", "the page")
