"""The page of the commands, from the command line itself: `.venv/bin/python tools/document_commands.py`."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import typer
import typer.main

from push_ident.cli.main import app

HEAD = """# Commands

Made from the command line itself. Every command works without a running node unless its description says so. Lengths are in metres,
angles in radians, unless they have their unit (`50mm`, `5cm`, `90deg`, `100mm/s`) or the name of
the option says another. An expected error is one line on the standard error, and exit status 1; wrong usage ends with exit status 2.
"""


def entry_of(option: Any) -> str:
    """An argument or an option, with its meaning."""
    if option.param_type_name == "argument":
        name = option.metavar or option.name.upper()
    else:
        name = ", ".join([*option.opts, *option.secondary_opts])
        if not option.is_flag:
            name += f" {option.metavar or option.name.upper()}"
    meaning = " ".join((option.help or "").split())
    if option.required:
        meaning += " Required."
    elif option.show_default and option.default not in (None, False, (), ""):
        meaning += f" Default: `{option.default}`."
    return f"`{name}`\n:   {meaning}\n"


def section_of(name: str, command: Any) -> str:
    arguments = [option for option in command.params if option.param_type_name == "argument"]
    options = [option for option in command.params if option.param_type_name != "argument" and not option.hidden and option.name != "help"]
    usage = " ".join(
        ["push-ident", name, *(option.metavar or option.name.upper() for option in arguments), *(["[OPTIONS]"] if options else [])]
    )
    lines = [f"## {name}", "", command.help or "", "", f"    {usage}", ""]
    lines += [entry_of(option) for option in (*arguments, *options)]
    return "\n".join(lines) + "\n"


def commands_of(group: Any, before: str = "") -> Iterator[tuple[str, Any]]:
    """Names and commands, those of a group with its name before theirs."""
    for listed in group.commands:
        name, command, _ = group.resolve_command(typer.Context(group), [listed])
        if hasattr(command, "commands"):
            yield from commands_of(command, f"{before}{name} ")
        else:
            yield before + name, command


def document() -> str:
    """The page in Markdown."""
    group: Any = typer.main.get_command(app)
    return "\n".join([HEAD, *(section_of(name, command) for name, command in commands_of(group))])


if __name__ == "__main__":
    print(document())
