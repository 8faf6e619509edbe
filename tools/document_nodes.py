"""The page of the nodes, from their code: topics, services, actions and parameters. `.venv/bin/python tools/document_nodes.py`."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from push_ident.nodes.base.cell_node import AUTOSTART

SOURCE = Path(__file__).resolve().parent.parent / "src"
PACKAGES = ("push_ident", "push_ident_sim")
ORDER = (
    "perception_node",
    "push_executor_node",
    "identification_node",
    "gap_diagnosis_node",
    "goal_pushing_node",
    "viewer_node",
    "bag_player_node",
    "bag_recorder_node",
    "sim_cell_node",
    "sim_hand_node",
)
HEAD = """# Nodes

Made from the code of the nodes. Names of topics are relative and can be remapped; `<id>` is the id of an object. Parameters marked
*fixed* are read at the start. Their values are in `src/*/config/*.yaml`. A player publishes, and a recorder takes in, every topic of the
[contract of bags](../how-to/own-data.md). A subscriber of a *latched* topic (transient local) gets its last message whenever it comes.

All nodes are lifecycle nodes that start themselves, unless `autostart` is false. What a node cannot use it refuses, and it names the last
refusal in `/diagnostics`: [decision 37](../decisions/0037-guarded-nodes.md).
"""
CALLS = {
    "create_publisher": "publishes",
    "create_lifecycle_publisher": "publishes",
    "create_subscription": "subscribes to",
    "create_service": "serves",
    "create_client": "calls",
    "create_action_server": "serves the action",
    "ActionClient": "calls the action",
}
PLACEHOLDERS = {"object_id": "<id>", "_TRUTH_ID": "<id>", "self._id": "<id>", "name": "<name>"}


@dataclass
class Module:
    """A file of a node or of what it uses."""

    name: str
    path: Path
    tree: ast.Module
    imports: set[str] = field(default_factory=set)


def modules(folders: tuple[str, ...] = PACKAGES) -> dict[str, Module]:
    """Modules below folders of the packages, by name."""
    found = {}
    for folder in folders:
        root = SOURCE / folder.partition("/")[0]
        for path in sorted((root / folder).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            found[name] = Module(name, path, ast.parse(path.read_text(encoding="utf-8")))
    for module in found.values():
        for node in ast.walk(module.tree):
            if isinstance(node, ast.ImportFrom) and node.module:
                module.imports.add(node.module)
                module.imports |= {f"{node.module}.{name.name}" for name in node.names}
    return found


def node_name(module: Module) -> str | None:
    """The node whose file, or table of parameters, this is."""
    candidates = [module.path.stem]
    if module.path.parent.parent.name == "nodes":
        candidates.append(f"{module.path.parent.name}_node")
    for candidate in candidates:
        if candidate in ORDER:
            return candidate
    return None


def used_by(name: str, known: dict[str, Module]) -> Iterator[Module]:
    """The node's own files and those of `nodes/` that they import, directly or not."""
    todo = [module.name for module in known.values() if node_name(module) == name]
    done: set[str] = set()
    while todo:
        current = todo.pop()
        if current in done or current not in known:
            continue
        done.add(current)
        yield known[current]
        todo += [
            other
            for other in known[current].imports
            if other.startswith("push_ident.nodes.") and other in known and node_name(known[other]) is None
        ]


def entities(module: Module, known: dict[str, Module]) -> Iterator[tuple[str, str, str]]:
    """What is published, subscribed to and served: (verb, name, type)."""
    for function in ast.walk(module.tree):
        if not isinstance(function, ast.FunctionDef):
            continue
        for call in ast.walk(function):
            if not isinstance(call, ast.Call):
                continue
            called = call.func.attr if isinstance(call.func, ast.Attribute) else call.func.id if isinstance(call.func, ast.Name) else ""
            if called not in CALLS:
                continue
            arguments = call.args[1:] if called.startswith("Action") else call.args
            if len(arguments) < 2:
                continue
            latched = ", latched" if called.endswith("publisher") and any("LATCHED" in ast.unparse(a) for a in arguments[2:]) else ""
            for kind, topic in pairs(arguments[0], arguments[1], function, module, known):
                yield CALLS[called], topic, kind + latched


def pairs(
    kind: ast.expr, topic: ast.expr, function: ast.FunctionDef, module: Module, known: dict[str, Module]
) -> Iterator[tuple[str, str]]:
    """Types and names; a loop over a table of them gives each."""
    if isinstance(kind, ast.Name):
        for loop in ast.walk(function):
            if isinstance(loop, ast.For) and isinstance(loop.target, ast.Tuple) and isinstance(loop.iter, ast.Tuple):
                names = [element.id if isinstance(element, ast.Name) else "" for element in loop.target.elts]
                if kind.id in names:
                    for row in loop.iter.elts:
                        if isinstance(row, ast.Tuple):
                            values = dict(zip(names, row.elts, strict=False))
                            yield from (
                                (type_name(values[kind.id]), name) for name in [text_of(topic, function, module, known, values)] if name
                            )
                    return
    name = text_of(topic, function, module, known, {})
    if name:
        yield type_name(kind), name


def type_name(kind: ast.expr) -> str:
    text = ast.unparse(kind)
    return re.sub(r"Msg$", "", text) if re.fullmatch(r"[A-Z]\w+", text) else ""


def text_of(topic: ast.expr, function: ast.FunctionDef, module: Module, known: dict[str, Module], values: dict[str, ast.expr]) -> str:
    """A name of a topic as far as the code fixes it; empty where it does not."""
    if isinstance(topic, ast.Constant):
        return str(topic.value)
    if isinstance(topic, ast.BinOp):
        left, right = (text_of(part, function, module, known, values) for part in (topic.left, topic.right))
        return left + right if left and right else ""
    if isinstance(topic, ast.JoinedStr):
        parts = [part.value if isinstance(part, ast.FormattedValue) else part for part in topic.values]
        return "".join(text_of(part, function, module, known, values) for part in parts)
    key = ast.unparse(topic)
    if key in values:
        return text_of(values[key], function, module, known, {})
    if key in PLACEHOLDERS:
        return PLACEHOLDERS[key]
    if isinstance(topic, ast.Name):
        scopes: list[ast.AST] = [function, module.tree, *(known[other].tree for other in module.imports if other in known)]
        for scope in scopes:
            for node in ast.walk(scope):
                target = node.targets[0] if isinstance(node, ast.Assign) else node.target if isinstance(node, ast.AnnAssign) else None
                value = node.value if isinstance(node, (ast.Assign, ast.AnnAssign)) else None
                if isinstance(target, ast.Name) and target.id == key and isinstance(value, (ast.Constant, ast.JoinedStr)):
                    return text_of(value, function, module, known, values)
    return ""


def parameters_of(name: str, known: dict[str, Module]) -> list[str]:
    for module in known.values():
        if node_name(module) != name or not re.search(r"^PARAMETERS\b.*= \($", module.path.read_text(encoding="utf-8"), re.MULTILINE):
            continue
        lines = ["", "| parameter | default | range | meaning |", "|---|---|---|---|"]
        for row in (*importlib.import_module(module.name).PARAMETERS, AUTOSTART):
            limits = ", ".join(row.choices) or ("" if row.minimum is None else f"{row.minimum:g} … {row.maximum:g}")
            lines.append(f"| `{row.name}` | `{row.default}` | {limits} | {row.description}{' *(fixed)*' if row.read_only else ''} |")
        return lines
    return []


def section_of(name: str, known: dict[str, Module]) -> str:
    main = [
        module
        for module in known.values()
        if node_name(module) == name and re.search(r"^class \w+Node\(CellNode\)", module.path.read_text("utf-8"), re.MULTILINE)
    ]
    if not main:
        raise LookupError(f"No file with the node {name}; expected nodes/{name}.py or nodes/{name.removesuffix('_node')}/.")
    what = (ast.get_docstring(main[0].tree) or "").replace(f"`{name}`: ", "").split("\n\n")[0]
    lines = [f"## {name}", "", what[:1].upper() + what[1:], ""]
    found = sorted(
        {entity for module in used_by(name, known) for entity in entities(module, known)},
        key=lambda e: (list(CALLS.values()).index(e[0]), e[1]),
    )
    lines += ["| | name | type |", "|---|---|---|"] if found else []
    lines += [f"| {verb} | `{topic}` | {kind} |" for verb, topic, kind in found]
    return "\n".join([*lines, *parameters_of(name, known)]) + "\n"


def document() -> str:
    """The page in Markdown."""
    known = modules()
    return "\n".join([HEAD, *(section_of(name, known) for name in ORDER)])


if __name__ == "__main__":
    print(document())
