"""Files for those who host, build and contribute: they can be read, and name targets, versions and files that exist."""

from __future__ import annotations

import json
import re
import tomllib
import xml.etree.ElementTree as ET
from typing import Any

import yaml

from helpers.paths import ROOT

GITHUB = ROOT / ".github"
UNTRIED = [*sorted((GITHUB / "workflows").glob("*.yml")), *(ROOT / name for name in ("Dockerfile", "pixi.toml"))]
UNTRIED += [ROOT / ".devcontainer" / "devcontainer.json"]
TARGETS = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE))
PACKAGES = ("push_ident", "push_ident_msgs", "push_ident_sim")


def jobs() -> dict[str, Any]:
    files = [yaml.safe_load(path.read_text(encoding="utf-8")) for path in (GITHUB / "workflows").glob("*.yml")]
    return {name: job for file in files for name, job in file["jobs"].items()}


def commands(job: dict[str, Any]) -> list[str]:
    """What a job runs, with each value of its matrix."""
    lines = [step["run"] for step in job["steps"] if "run" in step]
    for name, values in job.get("strategy", {}).get("matrix", {}).items():
        place = f"${{{{ matrix.{name} }}}}"
        lines = [line.replace(place, value) for line in lines for value in (values if place in line else values[:1])]
    return lines


def test_workflows_call_targets_that_exist_on_each_supported_python() -> None:
    lines = [line for job in jobs().values() for line in commands(job)]
    assert not [line for line in lines if not re.fullmatch(r"make [a-z-]+( PYTHON=python3\.\d+)?", line)]
    called = {line.split()[1] for line in lines}
    # The target of the oldest versions comes with requirements/oldest.txt.
    assert called <= TARGETS and {"test", "test-long", "dist-check", "docs", "test-oldest"} <= called
    for target in called - {"docs"}:
        assert {version for line in lines for version in re.findall(rf"^make {target} PYTHON=python(.+)$", line)} == {"3.11", "3.12"}


def test_hooks_before_a_commit_have_the_pinned_versions() -> None:
    (repository,) = yaml.safe_load((ROOT / ".pre-commit-config.yaml").read_text(encoding="utf-8"))["repos"]
    hooks = {hook["id"]: hook for hook in repository["hooks"]}
    assert list(hooks) == ["ruff", "ruff-format", "mypy"]
    pins = re.findall(r"^[\w-]+==[\w.]+", (ROOT / "requirements" / "dev.txt").read_text(encoding="utf-8"), re.MULTILINE)
    for hook in hooks.values():
        assert set(hook.get("additional_dependencies", [])) <= set(pins), hook["id"]
    assert hooks["ruff"]["additional_dependencies"] and hooks["mypy"]["entry"] == ".venv/bin/mypy"


def test_what_was_not_tried_says_so_in_its_first_lines() -> None:
    for path in UNTRIED:
        assert re.match(r'(# |\{\s*"//": ")Not tried: ', path.read_text(encoding="utf-8")), path
        assert path.name in (text := (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")) or str(path.parent.relative_to(ROOT)) in text


def test_containers_and_pixi_call_what_exists() -> None:
    container = json.loads((ROOT / ".devcontainer" / "devcontainer.json").read_text(encoding="utf-8"))
    docker = (ROOT / "Dockerfile").read_text(encoding="utf-8")
    stages = re.findall(r"^FROM ros:jazzy(?: AS (\w+))?$", docker, re.MULTILINE)
    assert stages == ["build", ""] and container["build"]["target"] == "build"
    pixi = tomllib.loads((ROOT / "pixi.toml").read_text(encoding="utf-8"))
    lines = [*pixi["tasks"].values(), container["postCreateCommand"], *re.findall("^RUN (.*)$", docker, re.MULTILINE)]
    called = {target for line in lines for target in re.findall(r"\bmake ([a-z-]+)", line)}
    assert called and called <= TARGETS
    assert "ros-jazzy-ros-base" in pixi["dependencies"] and any("robostack-jazzy" in channel for channel in pixi["workspace"]["channels"])


def test_templates_have_what_hosts_read_and_ask_for_commands_that_exist() -> None:
    names = []
    for path in sorted((GITHUB / "ISSUE_TEMPLATE").glob("*.md")):
        _, head, text = path.read_text(encoding="utf-8").split("---\n", 2)
        assert set(yaml.safe_load(head)) == {"name", "about"} and "doctor" in text, path
        names.append(path.stem)
    assert names == ["bug", "robot_or_camera", "wrong_answer"]
    template = GITHUB / "PULL_REQUEST_TEMPLATE.md"
    links = re.findall(r"\]\(([^)#]+)", template.read_text(encoding="utf-8"))
    assert links and all((template.parent / link).exists() for link in links)


def test_manifests_name_author_website_repository_and_issues() -> None:
    of_package = []
    for package in PACKAGES:
        manifest = ET.parse(ROOT / "src" / package / "package.xml").getroot()
        urls = {url.get("type", ""): url.text or "" for url in manifest.iter("url")}
        assert set(urls) == {"website", "repository", "bugtracker"} and all(url.startswith("https://") for url in urls.values())
        assert manifest.findtext("author") and manifest.findtext("maintainer")
        of_package.append(urls)
    assert of_package[0] == of_package[1] == of_package[2]
    for package in ("push_ident", "push_ident_sim"):
        setup = (ROOT / "src" / package / "setup.py").read_text(encoding="utf-8")
        assert all(f'"{url}"' in setup for url in of_package[0].values()) and "author=" in setup
