"""gap_diagnosis_node: pushes of a bag, diagnosed on request, and what identification_node makes of the outcome."""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from rclpy.action import ActionClient

from helpers.executor_cell import Stalls
from helpers.node_process import Talker
from helpers.spinning import running
from push_ident.identification.results.known_effects import effects_in_use
from push_ident.nodes.base.cell_node import LATCHED
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.model import posterior_from_msg
from push_ident.nodes.gap_diagnosis.gap_diagnosis_node import GapDiagnosisNode
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.nodes.recording.bag_player_node import BagPlayerNode
from push_ident.planning.belief import Belief
from push_ident_msgs.action import DiagnoseGap
from push_ident_msgs.msg import GapReport, ModelPosterior
from push_ident_msgs.srv import LoadModel
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes

pytestmark = pytest.mark.live

N_PUSHES = 6
TILT = 0.03
OBJECT = "hammer"


class Cell(Talker):
    """Nodes in this process to which a bag is played, and somebody who asks them."""

    def __init__(self, bag: Path, *, identifies: bool = False) -> None:
        domain = own_domain()
        super().__init__(domain)
        self.models: list[ModelPosterior] = []
        self.reports: list[GapReport] = []
        self.node.create_subscription(ModelPosterior, f"objects/{OBJECT}/model", self.models.append, LATCHED)
        self.node.create_subscription(GapReport, "gap_report", self.reports.append, LATCHED)
        self.diagnose = ActionClient(self.node, DiagnoseGap, "diagnose_gap")
        self.load = self.node.create_client(LoadModel, "load_diagnosis")
        self._nodes = ExitStack()
        # The outline of the bag is exact: no camera traced it.
        self._nodes.enter_context(running(GapDiagnosisNode, domain, "outline_from_camera:=false", n_threads=3))
        if identifies:
            self._nodes.enter_context(running(IdentificationNode, domain, "suggest_candidates:=0"))
        # At its end the player asks its process to end.
        self._nodes.callback(signal.signal, signal.SIGTERM, signal.signal(signal.SIGTERM, signal.SIG_IGN))
        player = (f"bag:={bag}", "rate:=0.0", f"listeners:={1 + identifies}", "wait:=300.0")
        self._nodes.enter_context(running(BagPlayerNode, domain, *player))
        self.until(lambda: self.values("gap_diagnosis_node").get("pushes") == str(N_PUSHES), timeout=600.0)

    def send(self, on_stage: Callable[[str], None] = lambda stage: None, **goal: object) -> Any:
        self.until(self.diagnose.server_is_ready)
        request = DiagnoseGap.Goal(**goal)
        return self.result_of(self.diagnose.send_goal_async(request, feedback_callback=lambda m: on_stage(m.feedback.stage)))

    def __exit__(self, *error: object) -> None:
        self._nodes.close()
        super().__exit__(*error)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bag = tmp_path_factory.mktemp("bags") / "tilted"
    record_pushes(bag, RecordingSettings(n_pushes=N_PUSHES, seed=2, effects=InjectedEffects.of({"table_tilt": (TILT, 0.0)})))
    return bag


@pytest.fixture(scope="module")
def cell(bag: Path) -> Iterator[Cell]:
    with Cell(bag) as cell:
        yield cell


def test_pushes_on_a_tilted_table_are_diagnosed_on_request(cell: Cell) -> None:
    stages: list[str] = []
    handle = cell.send(stages.append)
    assert handle.accepted
    result = cell.result_of(handle.get_result_async(), 360.0).result
    report = result.report
    assert result.success and result.message == report.verdict
    assert report.n_pushes == N_PUSHES and report.verdict in ("named", "one_of", "several")
    tilt = next(effect for effect in report.effects if effect.name == "table_tilt")
    assert list(tilt.parameters) == ["x", "y"]
    assert max(tilt.std) < 0.25 * TILT and all(
        abs(value - true) < 3 * std for value, true, std in zip(tilt.values, (TILT, 0.0), tilt.std, strict=True)
    )
    assert report.noise < report.after < 0.7 * report.before
    assert sum(part.mean for part in report.account) == pytest.approx(report.before, rel=1e-9)
    assert next(part for part in report.account if part.name.startswith("table_tilt")).mean == pytest.approx(report.before - report.after)
    assert report.ranking[0] == "table_tilt" and len(report.ranking) == len(report.ranking_evidence) == len(report.ranking_smallest)
    assert json.loads(report.json)["verdict"] == report.verdict
    assert "fitting the base model" in stages
    cell.until(lambda: cell.reports)
    assert cell.reports[-1] == report


def test_what_cannot_be_diagnosed_is_refused_and_cancel_ends_a_diagnosis_at_once(cell: Cell) -> None:
    for goal, why in (({"object_id": "o9"}, "no pushes of object `o9`"), ({"base_effects": ["ghosts"]}, "no effect `ghosts`")):
        result = cell.result_of(cell.send(**goal).get_result_async()).result
        assert not result.success and why in result.message
    started: list[str] = []
    handle = cell.send(started.append)
    cell.until(lambda: started)
    assert not cell.send().accepted, "one at a time"
    with Stalls() as stalls:
        asked = time.monotonic()
        cell.result_of(handle.cancel_goal_async())
        assert cell.result_of(handle.get_result_async()).status == GoalStatus.STATUS_CANCELED
        took = time.monotonic() - asked
    assert took < 3.0 + 6.0 * stalls.worst  # the diagnosis holds all processors until then


@pytest.mark.long
def test_what_is_named_live_acts_in_the_model_that_is_planned_with(bag: Path, tmp_path: Path) -> None:
    with Cell(bag, identifies=True) as cell:
        cell.until(lambda: cell.models and cell.models[-1].n_pushes == N_PUSHES, timeout=600.0)
        n_models = len(cell.models)
        report = cell.result_of(cell.send(object_id=OBJECT).get_result_async(), 600.0).result.report
        assert report.verdict in ("named", "several") and "table_tilt" in [effect.name for effect in report.effects]
        cell.until(lambda: len(cell.models) > n_models)
        _, posterior = posterior_from_msg(cell.models[-1])
        (effect,) = effects_in_use(posterior)
        assert effect.name == "table_tilt" and np.all(np.abs(effect.value - [TILT, 0.0]) < 4 * effect.std)
        assert Belief.of(posterior).mean.effects.names == ("table_tilt",) and cell.models[-1].n_pushes == N_PUSHES
        text = f"{OBJECT}: diagnosed effects"
        cell.until(lambda: "table_tilt" in cell.values("identification_node").get(text, ""))

        # The file of a diagnosis does the same; none at all takes the effect out of the model again.
        file = tmp_path / "diagnosis.json"
        file.write_text(report.json)
        for path, n_effects in (("", 0), (str(file), 1)):
            answer = cell.ask(cell.load, LoadModel.Request(object_id=OBJECT, path=path), timeout=300.0)
            assert answer.success, answer.message
            cell.until(lambda n=n_effects: len(effects_in_use(posterior_from_msg(cell.models[-1])[1])) == n)
