"""A new effect is one file: simulator, identification, diagnosis, exporters and documents find it with nothing else touched."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest

from helpers.commands import run_in_one_process
from helpers.paths import ROOT
from push_ident.physics.kernel import VARIABLE

TORQUE = 0.04
MASS, FRICTION = 0.969949, 0.382953
"""Of the simulated toolbox [kg], [-]."""
EFFECT = """
from push_ident.physics.effect import Effect, EffectParameter, Law, OnTable, equation


@equation
def _pull(p, body):
    nothing = 0.0 * body.mass
    return nothing, nothing, p[0] + nothing


EFFECT = Effect(
    name="swirl",
    what="A constant torque turns the object about the vertical.",
    equation="torque + tau",
    parameters=(EffectParameter("torque", "N m", "counter-clockwise", scale=0.04, typical=0.03, low=-0.1, high=0.1),),
    acts=OnTable(pull=_pull),
    law=Law.APPROXIMATE,
    signature="A turn to one side in every push.",
    rivals=(),
    source="Newton's second law.",
    check="Look for what turns the object.",
)
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the effect, for what the programs make of it."""
    folder = tmp_path_factory.mktemp("effect")
    (folder / "effects").mkdir()
    (folder / "effects" / "swirl.py").write_text(EFFECT)
    return folder


def run(folder: Path, *programs: tuple[object, ...]) -> list[str]:
    """What programs print that find the effect."""
    # Compiled quickly rather than to quick code: the kernels of an effect given by a folder run here only.
    environment = {**os.environ, VARIABLE: str(folder / "effects"), "OMP_NUM_THREADS": "1", "NUMBA_OPT": "1"}
    done, _ = run_in_one_process(programs, environment)
    assert not any(code for code, _ in done), done
    return [text for _, text in done]


def test_effect_of_a_new_file_is_documented_and_offered_for_injection(folder: Path) -> None:
    page, listed = run(folder, (ROOT / "tools" / "document_effects.py",), ("push-ident", "simulate", "--effects"))
    assert "A turn to one side in every push." in page
    assert "swirl: A constant torque turns the object about the vertical." in listed and "torque [N m]" in listed


@pytest.mark.long
def test_effect_of_a_new_file_is_simulated_diagnosed_and_exported(folder: Path) -> None:
    simulate = ("--object", "toolbox", "--effect", f"swirl={TORQUE}", "--pushes", "5", "--seed", "3")
    # Poses determine the ratio of the torque to the friction of the whole object, which is therefore given.
    known = ("--nominal-mass", MASS, "--friction", FRICTION)
    run(
        folder,
        ("push-ident", "simulate", *simulate, "--out", folder / "bag", "--truth", folder / "truth.json"),
        ("push-ident", "diagnose", folder / "bag", *known, "--out", folder, "--json", folder / "result.json"),
        ("push-ident", "export", folder / "model.json", "--format", "mjcf", "--out", folder / "model.xml"),
    )
    injected = json.loads((folder / "truth.json").read_text())
    assert injected["effects"] == {"swirl": [TORQUE]}
    assert sum(injected["mass_kg"]) == pytest.approx(MASS)
    assert np.average(injected["friction"], weights=injected["mass_kg"]) == pytest.approx(FRICTION)
    result = json.loads((folder / "result.json").read_text())
    (found,) = result["effects"]
    assert result["verdict"] == "named" and found["name"] == "swirl"
    assert found["parameters"]["torque"] == pytest.approx(TORQUE, rel=0.35)
    assert "swirl (torque = " in (folder / "model.xml").read_text()
