"""Every option that a text names is one of the command that prints it."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from typing import Any

import typer
import typer.main

from helpers.paths import SOURCE, nodes
from push_ident.cli.main import app

CORE = SOURCE / "push_ident" / "push_ident"
READ = ("look", "identify", "predict", "diagnose")
TRACKED = ("import csv", "import rosbag")
PRINTED_BY = {
    "axes": TRACKED,
    "bag_view": ("view",),
    "cmu_fingers": ("import cmu-fingers",),
    "cmu_icra16": ("import cmu-icra16",),
    "cmu_mocap": ("import cmu-mocap",),
    "depth_images": ("look",),
    "import_page": ("identify",),
    "mit": ("import mit",),
    "overlap": TRACKED,
    "read_options": READ,
    "reader": READ,
    "recording": TRACKED,
    "rosbag": ("import rosbag",),
    "scale_check": ("look",),
    "survey": ("look",),
    "tracked_poses": ("import csv",),
}
"""Commands by the module whose texts they print, outside `cli`."""
SHARED = {
    "overrides": ("up",),
    "push_several": ("push-to",),
    "robot": ("up", "replay"),
    "robot_doctor": ("doctor",),
    "live_view": ("up",),
    "scene": ("fix", "diagnose"),
    "output": ("identify",),
}
"""Those of modules of `cli` that hold no command."""
ONLY_WITH = {
    ("recording", "--time-unit"): "import csv",
    ("recording", "--log-time"): "import rosbag",
    ("overlap", "--angle-unit"): "import csv",
    ("recording", "--angle-unit"): "import csv",
    ("push_to", "--goal"): "demo",
}
"""Remedies of shared modules that are printed for one command only."""
OF_OTHERS = {"--ros-args", "--enclave", "--params-file", "--log-level", "--head", "--port", "--bind", "--web-viewer-port", "--serve-web"}
OF_OTHERS |= {"--server-memory-limit", "--help", "--version", "--src", "--dst", "--dst-storage"}
"""Of programs that are started, and of `push-ident` without a command."""
OPTION = re.compile(r"(?<![\w-])--[a-z][a-z-]*[a-z]")
COMMAND = re.compile(r"(?:`?push-ident |`)((?:import )?[a-z][a-z0-9-]*)")


@cache
def options() -> dict[str, set[str]]:
    """Options by command; of a group with its name before."""

    def found(group: Any, before: str = "") -> Iterator[tuple[str, set[str]]]:
        for listed in list(group.commands):
            name, command, _ = group.resolve_command(typer.Context(group), [listed])
            if hasattr(command, "commands"):
                yield from found(command, f"{before}{name} ")
            else:
                yield before + name, {option for parameter in command.params for option in (*parameter.opts, *parameter.secondary_opts)}

    return dict(found(typer.main.get_command(app)))


@cache
def commands_of_module() -> dict[str, tuple[str, ...]]:
    group: Any = typer.main.get_command(app)
    found: dict[str, tuple[str, ...]] = {}
    for name, lazy in group.lazy_subcommands.items():
        module = lazy.place.rpartition(":")[0].rpartition(".")[2]
        own = tuple(command for command in options() if command == name or command.startswith(f"{name} "))
        found[module] = (*found.get(module, ()), *own)
    return found


def texts() -> Iterator[tuple[str, bool, str]]:
    """Module, whether it is one of `cli`, and each text in it that names an option, docstrings and parts of texts excluded."""
    for path in sorted(CORE.rglob("*.py")):
        inner = {id(part) for node in nodes(path) if isinstance(node, ast.JoinedStr) for part in ast.walk(node) if part is not node}
        inner |= {id(node.value) for node in nodes(path) if isinstance(node, ast.Expr)}
        for node in nodes(path):
            if id(node) in inner or not isinstance(node, ast.JoinedStr | ast.Constant):
                continue
            parts = node.values if isinstance(node, ast.JoinedStr) else [node]
            text = "".join(str(part.value) if isinstance(part, ast.Constant) else "X" for part in parts)
            if "var(--" not in text and (set(OPTION.findall(text)) - OF_OTHERS):
                yield path.stem, path.is_relative_to(CORE / "cli"), text


def test_each_option_that_a_text_names_is_one_of_the_command_that_prints_it() -> None:
    wrong = []
    for module, is_cli, text in texts():
        named = [command for command in COMMAND.findall(text) if command in options()]
        printing = named or ((*commands_of_module().get(module, ()), *SHARED.get(module, ())) if is_cli else PRINTED_BY.get(module, ()))
        for option in set(OPTION.findall(text)) - OF_OTHERS:
            only = ONLY_WITH.get((module, option))
            # Of a module with several commands each text is of one of them; of the others all print every text.
            has = [option in options()[command] for command in ((only,) if only else printing)]
            if not has or not (any(has) if is_cli and not named else all(has)):
                wrong.append((module, option, text[:100]))
    assert wrong == []


def test_a_text_with_an_option_that_no_command_has_is_found() -> None:
    assert "--remap" not in options()["look"] and "--map" in options()["look"] and "--length-unit" in options()["import rosbag"]
    assert COMMAND.findall("`push-ident look`, `identify` and `push-ident import csv FILE` take it") == ["look", "identify", "import csv"]
    assert OPTION.findall("give --depth-unit 0.1 (--known WxD), not -- or a--b") == ["--depth-unit", "--known"]
    assert len(list(texts())) > 50
