"""Commands that documents show are complete: they exist with their options, and their files exist or are made on the page."""

from __future__ import annotations

import functools
import importlib
import re
import runpy
import shlex
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import typer.main
import yaml

from helpers.paths import ROOT
from helpers.spinning import running
from push_ident.cli.main import app
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.executables import NODES
from push_ident.nodes.gap_diagnosis.gap_diagnosis_node import GapDiagnosisNode
from push_ident_sim.executables import NODES as SIM_NODES

PAGES = [
    *sorted((ROOT / "docs").rglob("*.md")),
    *sorted((ROOT / ".github").rglob("*.md")),
    *(
        ROOT / name
        for name in ("README.md", "SAFETY.md", "SECURITY.md", "CONTRIBUTING.md", "CONVENTIONS.md", "ARCHITECTURE.md", "bags/README.md")
    ),
]
PROGRAMS = ("push-ident", "ros2", "make", "python", "pip", "rviz2", "rerun", "rosbags-convert", "pytest", "cp", "printf")
VERBS = {
    "action": {"send_goal", "list", "info"},
    "bag": {"record", "play", "info", "convert"},
    "control": {"list_controllers", "set_controller_state", "unload_controller"},
    "doctor": set(),
    "interface": {"show"},
    "launch": set(),
    "lifecycle": {"set", "get"},
    "node": {"list", "info"},
    "param": {"get", "set", "dump", "describe", "list"},
    "pkg": {"prefix"},
    "run": set(),
    "security": {"create_keystore", "generate_artifacts"},
    "service": {"call", "list"},
    "topic": {"list", "echo", "hz", "info"},
}
"""Commands of `ros2` in Jazzy that documents show."""
OF_OTHERS = {"lab.mcap", "lab.bag", "take 1.csv", "my_bag"}
"""Files that stand for those of the reader."""
WRITES = {"--out", "--json", "--page", "--truth", "--dst", "-o", ">"}
"""What comes after is made by the command."""


@dataclass(frozen=True)
class Shown:
    """A command of a page."""

    page: Path
    line: str
    words: tuple[str, ...]
    is_block: bool
    """A line to be copied; else a mention within a sentence or a table."""

    def __str__(self) -> str:
        return f"{self.page.relative_to(ROOT)}: {' '.join(self.words)}"


def lines_of(text: str) -> Iterator[tuple[str, bool]]:
    """Lines of blocks, and what stands between backticks elsewhere."""
    fenced = None
    for line in text.splitlines():
        if mark := re.match(r" *```(\w*)", line):
            fenced = None if fenced is not None else mark[1]
        elif fenced in ("", "bash", "sh") or (fenced is None and re.match(r" {4,}\S", line)):
            yield line.strip(), True
        if fenced is None:
            yield from ((code.replace("\\|", "|"), False) for code in re.findall(r"`([^`]+)`", line))


@functools.cache
def shown() -> list[Shown]:
    found = []
    for page in PAGES:
        for line, is_block in lines_of(page.read_text(encoding="utf-8")):
            for part in re.split(r"; |&& | &$| \|\| ", line):
                try:
                    words = shlex.split(re.sub(r"\s#.*", "", part))
                except ValueError:
                    continue
                while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                    words = words[1:]
                if len(words) > 1 and words[0] in PROGRAMS and not (is_block and "`" in part):
                    found.append(Shown(page, line, tuple(words), is_block))
    return found


def of(program: str) -> list[Shown]:
    return [one for one in shown() if one.words[0] == program]


def test_commands_of_this_package_have_their_options_and_what_they_require() -> None:
    group: Any = typer.main.get_command(app)
    wrong, n_blocks = [], 0
    for one in of("push-ident"):
        command, rest = group, list(one.words[1:])
        while hasattr(command, "commands") and rest and re.match("[a-z]", rest[0]):
            if rest[0] not in command.list_commands(typer.Context(command)):
                wrong.append(f"{one}: no command {rest[0]}")
                break
            _, command, rest = command.resolve_command(typer.Context(command), rest)
        options = {name: option for option in command.params for name in (*option.opts, *option.secondary_opts)}
        given = [word.partition("=")[0] for word in rest if re.match(r"--?[a-z]", word)]
        wrong += [f"{one}: no option {word}" for word in given if word not in (*options, "--help", "--version")]
        if one.is_block:
            n_blocks += 1
            required = [(name, option) for name, option in options.items() if option.required]
            wrong += [f"{one}: {name} is required" for name, option in required if is_missing(name, option, given, rest)]
    assert not wrong
    assert n_blocks >= 40


def is_missing(name: str, option: Any, given: list[str], rest: list[str]) -> bool:
    """Whether a required option, or every argument, is missing."""
    return not any(not word.startswith("-") for word in rest) if option.param_type_name == "argument" else name not in given


@functools.cache
def launch_arguments(package: str, file: str) -> set[str]:
    text = (ROOT / "src" / package / "launch" / file).read_text(encoding="utf-8")
    return {*re.findall(r'DeclareLaunchArgument\("(\w+)"', text), *re.findall(r'^    "(\w+)": "[\w/]+",$', text, re.MULTILINE)}


def interface(name: str) -> Any:
    """Class of `package/srv/Name`; AttributeError or ImportError where there is none."""
    package, kind, name = name.split("/")
    return getattr(importlib.import_module(f"{package}.{kind}"), name)


def fields_missing(kind: Any, text: str) -> set[str]:
    """Fields of a request or goal as text that its type does not have."""
    values = yaml.safe_load(text)
    assert isinstance(values, dict), text
    return set(values) - set(kind.get_fields_and_field_types())


def check_node(executable: str, words: list[str]) -> None:
    """That a node of this project has this executable, and each parameter after `-p`."""
    module = importlib.import_module({**NODES, **SIM_NODES}[executable])
    folder = importlib.import_module(module.__name__.rpartition(".")[0] + ".parameters") if not hasattr(module, "PARAMETERS") else module
    known = {parameter.name for parameter in folder.PARAMETERS}
    given = [words[k + 1].partition(":=")[0] for k, word in enumerate(words) if word == "-p"]
    assert set(given) <= known, given


@pytest.mark.parametrize("one", of("ros2"), ids=str)
def test_commands_of_ros2_fit_these_packages(one: Shown) -> None:
    verb, *rest = one.words[1:]
    assert verb in VERBS
    if not rest or rest == ["send_goal"]:
        return  # only named
    assert not VERBS[verb] or rest[0] in VERBS[verb]
    assert all(word not in "…." and not word.startswith("...") for word in rest), "a path that is left out"
    if verb == "launch" and rest[0].startswith("push_ident"):
        given = {word.partition(":=")[0] for word in rest[2:]}
        assert given <= launch_arguments(rest[0], rest[1])
    elif verb == "run" and rest[0].startswith("push_ident"):
        check_node(rest[1], rest[2:])
        assert len(rest) == 2 or rest[2] == "--ros-args"
    elif verb in ("service", "action") and rest[0] not in ("list", "info"):
        kind = interface(rest[2])
        if len(rest) > 3:
            assert not fields_missing(kind.Request if verb == "service" else kind.Goal, rest[3])
    elif verb == "interface":
        interface(rest[1])


def test_nodes_that_python_starts_have_the_parameters_that_are_given() -> None:
    started = [one for one in of("python") if one.words[1:3] == ("-m", "push_ident.nodes")]
    for one in started:
        check_node(one.words[3], list(one.words[4:]))
    assert started


def test_targets_of_make_exist() -> None:
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
    called = {word for one in of("make") for word in one.words[1:] if re.fullmatch(r"[a-z][a-z-]*", word)}
    assert called <= targets


def test_parameters_and_remappings_are_shown_in_a_whole_command() -> None:
    half = []
    for page in PAGES:
        for line, _ in lines_of(page.read_text(encoding="utf-8")):
            if re.match(r"-p \w", line) or (
                ":=" in line and not re.search(r"^\S*--remap|FROM:=|(ros2|push-ident|push_ident\.nodes|xacro) ", line)
            ):
                half.append(f"{page.name}: {line}")
    assert not half


def test_files_of_commands_exist_or_are_made_or_described_before_on_their_page() -> None:
    """Made: written by a command, or in the folder that one writes; described: named in the text."""
    missing = []
    for one in (one for one in shown() if one.is_block):
        before = one.page.read_text(encoding="utf-8").partition(one.line)[0]
        earlier = [other for other in shown() if other.page == one.page and (other.line in before or other.line == one.line)]
        written = [word for other in earlier for word in after(WRITES, other.words)]
        named = re.findall(r"`([\w./-]+)`", before)
        for last, word in pairwise(one.words):
            file = word.partition("#")[0]
            is_file = re.search(r"\.(yaml|csv|json|urdf|sdf|xml|mcap|rrd|txt|py|rviz)$", file) and file[0] not in "-$(/"
            if not is_file or last in WRITES or file in OF_OTHERS or one.words[0] == "ros2" or file.startswith("MLab_EXP/"):
                continue
            is_made = file in (*written, *named) or any(file.startswith(f"{folder}/") for folder in written)
            if not is_made and not (ROOT / file).exists():
                missing.append(f"{one}: {file}")
    assert not missing, "\n".join(missing)


def after(flags: set[str], words: tuple[str, ...]) -> list[str]:
    """Words that follow one of these; what `cp` and scripts of the documentation write is their last word."""
    made = [word for last, word in pairwise(words) if last in flags]
    return [*made, words[-1]] if words[0] in ("cp", "python") else made


@pytest.mark.live
def test_script_in_place_of_ros2_asks_a_running_node(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    domain = own_domain()
    monkeypatch.setenv("ROS_DOMAIN_ID", str(domain))

    def asked(*words: str) -> str:
        monkeypatch.setattr(sys, "argv", ["ask_ros.py", *words])
        runpy.run_path(str(ROOT / "docs" / "examples" / "ask_ros.py"), run_name="__main__")
        return capsys.readouterr().out.strip()

    with running(GapDiagnosisNode, domain):
        assert "/gap_diagnosis_node" in asked("nodes").splitlines()
        assert "/gap_report push_ident_msgs/msg/GapReport" in asked("topics").splitlines()
        assert "DiagnosticArray(" in asked("echo", "/diagnostics")
        assert "messages in 3 s" in asked("hz", "/diagnostics", "3")
        parameters = dict(line.partition(": ")[::2] for line in asked("params", "/gap_diagnosis_node").splitlines())
        name, value = next((name, value) for name, value in parameters.items() if re.fullmatch(r"\d+\.\d+", value))
        assert asked("get", "/gap_diagnosis_node", name) == f"{name}: {value}"
        assert asked("set", "/gap_diagnosis_node", name, value).startswith(("set", "refused: "))
        assert asked("lifecycle", "/gap_diagnosis_node", "deactivate").splitlines() == ["done", "inactive"]
        assert "label='inactive'" in asked("call", "/gap_diagnosis_node/get_state")
