"""A new effect is one file: simulator, identification, diagnosis, exporters and documents find it with nothing else touched."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from push_ident.physics.effect_folders import VARIABLE

ROOT = Path(__file__).resolve().parents[2]
COMMANDS = """
import json, sys
from push_ident.cli.main import main
for arguments in json.load(sys.stdin):
    sys.argv = ["push-ident", *arguments]
    try:
        main()
    except SystemExit as ended:
        if ended.code:
            raise
"""
"""In one process: each would compile the kernels of the effect anew."""
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
PLANAR = """
import numpy as np
from push_ident.types import PusherPath
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object

away = PusherPath(np.array([0.0, 0.01]), np.full((2, 2), 5.0), 0.008)
turned = [
    PlanarWorld(make_object("toolbox"), 0.008, effects=InjectedEffects.of({"swirl": torque})).push((0.0, 0.0, 0.0), away).pose[-1, 2]
    for torque in (0.0, 0.1)
]
# Held by friction, a small torque turns it by as much as the bristles under its cells give way.
assert turned[0] == 0.0 and 1e-5 < turned[1] < 1e-2, turned
"""


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("effects")
    (folder / "swirl.py").write_text(EFFECT)
    return {**os.environ, VARIABLE: str(folder), "OMP_NUM_THREADS": "1"}


def run(environment: dict[str, str], *arguments: str | Path, text: str = "") -> str:
    call = [sys.executable, *map(str, arguments)]
    done = subprocess.run(call, env=environment, input=text, capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


def push_ident(environment: dict[str, str], *commands: Sequence[str | Path]) -> str:
    return run(environment, "-c", COMMANDS, text=json.dumps([[str(argument) for argument in command] for command in commands]))


def test_effect_of_a_new_file_is_documented_and_offered_for_injection(environment: dict[str, str]) -> None:
    assert "A turn to one side in every push." in run(environment, ROOT / "tools" / "document_effects.py")
    listed = push_ident(environment, ("simulate", "--effects"))
    assert "swirl: A constant torque turns the object about the vertical." in listed and "torque [N m]" in listed


def test_effect_of_a_new_file_acts_in_the_planar_engine(environment: dict[str, str]) -> None:
    run(environment, "-c", PLANAR)


def test_effect_of_a_new_file_is_simulated_diagnosed_and_exported(environment: dict[str, str], tmp_path: Path) -> None:
    bag, truth, out = tmp_path / "bag", tmp_path / "truth.json", tmp_path / "out"
    simulate = ("--object", "toolbox", "--effect", f"swirl={TORQUE}", "--pushes", "5", "--seed", "3")
    # Poses determine the ratio of the torque to the friction of the whole object, which is therefore given.
    known = ("--nominal-mass", str(MASS), "--friction", str(FRICTION))
    push_ident(
        environment,
        ("simulate", *simulate, "--out", bag, "--truth", truth),
        ("diagnose", bag, *known, "--out", out, "--json", out / "result.json"),
        ("export", out / "model.json", "--format", "mjcf", "--out", out / "model.xml"),
    )
    injected = json.loads(truth.read_text())
    assert injected["effects"] == {"swirl": [TORQUE]}
    assert sum(injected["mass_kg"]) == pytest.approx(MASS)
    assert np.average(injected["friction"], weights=injected["mass_kg"]) == pytest.approx(FRICTION)
    result = json.loads((out / "result.json").read_text())
    (found,) = result["effects"]
    assert result["verdict"] == "named" and found["name"] == "swirl"
    assert found["parameters"]["torque"] == pytest.approx(TORQUE, rel=0.35)
    assert "swirl (torque = " in (out / "model.xml").read_text()
