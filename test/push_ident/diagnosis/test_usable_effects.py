"""Which effects of a diagnosis may join the model of an object: those that its own rule takes as certain."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from push_ident.diagnosis.usable_effects import usable_effects, usable_effects_of_file, usable_effects_of_text
from push_ident.errors import InputError, ModelFileError


def diagnosis(verdict: str = "named", name: str = "table_tilt", **fields: Any) -> dict[str, Any]:
    """Content of a file, as far as it counts; `fields` replace some of it."""
    parameters = {"table_tilt": ("x", "y"), "tool_offset": ("x", "y")}.get(name, ("excess",))
    effect = {"name": name, "parameters": dict.fromkeys(parameters, 0.02), "std": dict.fromkeys(parameters, 0.002), "evidence": 20.0}
    content = {
        "verdict": verdict,
        "sentence": "",
        "effects": [effect],
        "probabilities": {"table_tilt": 0.9, "tool_offset": 0.45, "camera_translation": 0.45, "pusher_friction": 0.9, "nothing": 0.02},
        "gap": {"before_per_push_m": [1e-3] * 6, "before_m": None},
    }
    return content | fields


@pytest.mark.parametrize(
    ("content", "names"),
    [
        (diagnosis(), ["table_tilt"]),
        (diagnosis("several"), ["table_tilt"]),
        (diagnosis("one_of", "tool_offset"), ["tool_offset"]),  # open to its exact twin only
        (diagnosis("no_gap"), []),
        (diagnosis(name="pusher_friction"), []),  # an unknown of every model
    ],
)
def test_effects_with_enough_probability_are_used(content: dict[str, Any], names: list[str], tmp_path: Path) -> None:
    (tmp_path / "diagnosis.json").write_text(json.dumps(content))
    for found in (usable_effects_of_text(json.dumps(content), "it"), usable_effects_of_file(tmp_path / "diagnosis.json")):
        assert [effect.name for effect in found.effects] == names and found.n_pushes == 6
        assert "pusher_lag" in found.base and "table_tilt" not in found.base


@pytest.mark.parametrize(
    ("content", "why"),
    [
        (diagnosis(probabilities={"table_tilt": 0.8}), "probability of 0.80, expected 0.86"),
        (diagnosis("several", "tool_offset", probabilities={"tool_offset": 0.45}), "probability of 0.45"),
        (diagnosis("unknown"), "`unknown`"),
        (diagnosis("not_trustworthy", probabilities=None), "`not_trustworthy`"),
        (diagnosis(effects=[{"name": "ghosts", "parameters": {}, "std": {}}]), "no effect of this version"),
        (diagnosis(effects=[{"name": "friction_by_place", "parameters": {"largest": 0.3}, "std": {"largest": 0.1}}]), "free law"),
        (diagnosis(effects=[{"name": "table_tilt", "parameters": {"z": 1.0}, "std": {"z": 1.0}}]), "expected x, y"),
        (diagnosis(effects=[{"name": "table_tilt", "parameters": {"x": float("nan"), "y": 0.0}, "std": {}}]), "not a diagnosis"),
        ({"format": "push_ident/model/1"}, "not a diagnosis: verdict"),
    ],
)
def test_what_is_open_or_no_effect_is_refused_with_its_reason(content: dict[str, Any], why: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=why):
        usable_effects(content)
    if why.startswith("not a"):
        (tmp_path / "other.json").write_text(json.dumps(content))
        with pytest.raises(ModelFileError, match="not a diagnosis"):
            usable_effects_of_file(tmp_path / "other.json")
