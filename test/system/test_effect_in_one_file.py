"""A new effect is one file: simulator, identification, diagnosis, exporters and documents find it with nothing else touched."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from push_ident.physics.kernel import VARIABLE

ROOT = Path(__file__).resolve().parents[2]
PROGRAM = """
import json, runpy, sys
from contextlib import redirect_stdout
from push_ident.cli.main import main
for output, (program, *arguments) in json.load(sys.stdin):
    sys.argv = [program, *arguments]
    with open(output, "w") as file, redirect_stdout(file):
        try:
            main() if program == "push-ident" else runpy.run_path(program, run_name="__main__")
        except SystemExit as ended:
            if ended.code:
                raise
"""
"""Programs one after another in one process: each process would compile the kernels of the effect anew."""
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
FOUND = """
import json
import numpy as np
from push_ident.physics.effects import CAUSES
from push_ident.types import PusherPath
from push_ident_sim.engines.planar import PlanarWorld
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.objects import make_object

away = PusherPath(np.array([0.0, 0.01]), np.full((2, 2), 5.0), 0.008)
turned = [
    PlanarWorld(make_object("toolbox"), 0.008, effects=InjectedEffects.of({"swirl": torque})).push((0.0, 0.0, 0.0), away).pose[-1, 2].item()
    for torque in (0.0, 0.1)
]
print(json.dumps([turned, CAUSES]))
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with the effect, for what the programs make of it."""
    folder = tmp_path_factory.mktemp("effect")
    (folder / "effects").mkdir()
    (folder / "effects" / "swirl.py").write_text(EFFECT)
    (folder / "found.py").write_text(FOUND)
    return folder


def run(folder: Path, programs: dict[str, tuple[object, ...]]) -> None:
    """Run programs with the effect; what each printed is in NAME.txt."""
    calls = [[str(folder / f"{name}.txt"), list(map(str, program))] for name, program in programs.items()]
    # Compiled quickly rather than to quick code: the kernels of an effect given by a folder run here only.
    environment = {**os.environ, VARIABLE: str(folder / "effects"), "OMP_NUM_THREADS": "1", "NUMBA_OPT": "1"}
    call = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(call, env=environment, input=json.dumps(calls), capture_output=True, text=True, timeout=1800, check=False)
    assert done.returncode == 0, done.stderr


def test_effect_of_a_new_file_is_documented_offered_for_injection_and_as_a_cause_and_acts_in_the_planar_engine(folder: Path) -> None:
    page, listed = (ROOT / "tools" / "document_effects.py",), ("push-ident", "simulate", "--effects")
    run(folder, {"page": page, "listed": listed, "found": (folder / "found.py",)})
    assert "A turn to one side in every push." in (folder / "page.txt").read_text()
    text = (folder / "listed.txt").read_text()
    assert "swirl: A constant torque turns the object about the vertical." in text and "torque [N m]" in text
    (still, turned), causes = json.loads((folder / "found.txt").read_text())
    # Held by friction, a small torque turns it by as much as the bristles under its cells give way.
    assert "swirl" in causes and still == 0.0 and 1e-5 < turned < 1e-2


@pytest.mark.long
def test_effect_of_a_new_file_is_simulated_diagnosed_and_exported(folder: Path) -> None:
    simulate = ("--object", "toolbox", "--effect", f"swirl={TORQUE}", "--pushes", "5", "--seed", "3")
    # Poses determine the ratio of the torque to the friction of the whole object, which is therefore given.
    known = ("--nominal-mass", MASS, "--friction", FRICTION)
    programs: dict[str, tuple[object, ...]] = {
        "simulated": ("push-ident", "simulate", *simulate, "--out", folder / "bag", "--truth", folder / "truth.json"),
        "diagnosed": ("push-ident", "diagnose", folder / "bag", *known, "--out", folder, "--json", folder / "result.json"),
        "exported": ("push-ident", "export", folder / "model.json", "--format", "mjcf", "--out", folder / "model.xml"),
    }
    run(folder, programs)
    injected = json.loads((folder / "truth.json").read_text())
    assert injected["effects"] == {"swirl": [TORQUE]}
    assert sum(injected["mass_kg"]) == pytest.approx(MASS)
    assert np.average(injected["friction"], weights=injected["mass_kg"]) == pytest.approx(FRICTION)
    result = json.loads((folder / "result.json").read_text())
    (found,) = result["effects"]
    assert result["verdict"] == "named" and found["name"] == "swirl"
    assert found["parameters"]["torque"] == pytest.approx(TORQUE, rel=0.35)
    assert "swirl (torque = " in (folder / "model.xml").read_text()
