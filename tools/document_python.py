"""Pages of the Python reference: one for each stage, with every public name of its modules, in the order of the import rule."""

from __future__ import annotations

from pathlib import Path

SOURCE = Path(__file__).resolve().parent.parent / "src"
STAGES = {
    "push_ident": (
        "types",
        "errors",
        "pages",
        "geometry",
        "perception",
        "pushing",
        "physics",
        "physics.effects",
        "identification",
        "simulators",
        "planning",
        "diagnosis",
        "recovery",
        "bags",
        "offline",
        "fleet",
        "api",
        "nodes",
        "cli",
    ),
    "push_ident_sim": ("objects", "cell", "engines", "injected", "recordings", "studies"),
}


def modules_of(package: str, stage: str) -> list[str]:
    """Dotted names of the modules of a stage, without those of stages within it; the package itself first."""
    root = SOURCE / package
    folder = root / package / stage.replace(".", "/")
    if not folder.is_dir():
        return [f"{package}.{stage}"] if folder.with_suffix(".py").is_file() else []
    others = [root / package / other.replace(".", "/") for other in STAGES[package] if other.startswith(f"{stage}.")]
    paths = [path for path in sorted(folder.rglob("*.py")) if not any(other in path.parents for other in others)]
    names = [".".join(path.relative_to(root).with_suffix("").parts).removesuffix(".__init__") for path in paths]
    return sorted(names, key=lambda name: (name != f"{package}.{stage}", name))


def pages() -> dict[str, str]:
    """Path of each page in the site, and its Markdown."""
    found = {}
    number = 0
    for package, stages in STAGES.items():
        for stage in stages:
            modules = modules_of(package, stage)
            if not modules:
                continue
            number += 1
            parts = [f"---\ntitle: {package}.{stage}\n---\n# {package}.{stage}\n"]
            for module in modules:
                heading = "" if module == f"{package}.{stage}" else f"## {module.removeprefix(f'{package}.')}\n\n"
                parts.append(f"{heading}::: {module}\n    options:\n      show_submodules: false\n      heading_level: 3\n")
            found[f"reference/python/{number:02d}-{package}.{stage}.md"] = "\n".join(parts)
    return found
