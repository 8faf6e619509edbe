"""gap_diagnosis_node and identification_node as real processes: what the one names on a tilted table, the other fits and publishes."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rclpy.action import ActionClient
from rclpy.qos import DurabilityPolicy, QoSProfile

from helpers.node_process import NodeProcess, Talker
from push_ident.identification.results.known_effects import effects_in_use
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.convert.model import posterior_from_msg
from push_ident.planning.belief import Belief
from push_ident_msgs.action import DiagnoseGap
from push_ident_msgs.msg import GapReport, ModelPosterior
from push_ident_msgs.srv import LoadModel
from push_ident_sim.injected import InjectedEffects
from push_ident_sim.recordings.recording import RecordingSettings, record_pushes

pytestmark = [pytest.mark.alone, pytest.mark.long]

N_PUSHES = 6
TILT = 0.03
OBJECT = "hammer"
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Cell(Talker):
    """Somebody who listens to both nodes and asks them."""

    def __init__(self, domain: int) -> None:
        super().__init__(domain)
        self.models: list[ModelPosterior] = []
        self.reports: list[GapReport] = []
        self.node.create_subscription(ModelPosterior, f"objects/{OBJECT}/model", self.models.append, LATCHED)
        self.node.create_subscription(GapReport, "gap_report", self.reports.append, LATCHED)
        self.diagnose = ActionClient(self.node, DiagnoseGap, "diagnose_gap")
        self.load = self.node.create_client(LoadModel, "load_diagnosis")

    def answer(self, path: str) -> LoadModel.Response:
        """Of `load_diagnosis`."""
        return self.ask(self.load, LoadModel.Request(object_id=OBJECT, path=path), timeout=300.0)


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Cell]:
    folder, domain = tmp_path_factory.mktemp("cell"), own_domain()
    record_pushes(folder / "bag", RecordingSettings(n_pushes=N_PUSHES, seed=2, effects=InjectedEffects.of({"table_tilt": (TILT, 0.0)})))
    own: dict[str, dict[str, object]] = {
        "gap_diagnosis_node": {"outline_from_camera": False},
        "identification_node": {"suggest_candidates": 0},
        "bag_player_node": {"bag": str(folder / "bag"), "rate": 0.0, "listeners": 2, "wait": 300.0},
    }
    with Cell(domain) as cell:
        nodes = [NodeProcess(name, "push_ident.nodes", parameters, domain, folder) for name, parameters in own.items()]
        try:
            cell.until(lambda: cell.models and cell.models[-1].n_pushes == N_PUSHES, timeout=600.0)
            cell.until(lambda: cell.values("gap_diagnosis_node").get("pushes") == str(N_PUSHES))
            yield cell
        finally:
            for node in nodes:
                node.stop()
    assert not any("Traceback" in node.output for node in nodes), [node.output[-3000:] for node in nodes]


def result_of(cell: Cell, future: Any) -> Any:
    cell.until(future.done, timeout=600.0)
    return future.result()


def test_what_is_named_live_acts_in_the_model_that_is_planned_with(cell: Cell, tmp_path: Path) -> None:
    n_models = len(cell.models)
    handle = result_of(cell, cell.diagnose.send_goal_async(DiagnoseGap.Goal(object_id=OBJECT)))
    report = result_of(cell, handle.get_result_async()).result.report
    assert report.verdict in ("named", "several") and "table_tilt" in [effect.name for effect in report.effects]
    cell.until(lambda: len(cell.models) > n_models)
    _, posterior = posterior_from_msg(cell.models[-1])
    (found,) = effects_in_use(posterior)
    assert found.name == "table_tilt" and np.all(np.abs(found.value - [TILT, 0.0]) < 4 * found.std)
    assert Belief.of(posterior).mean.effects.names == ("table_tilt",) and cell.models[-1].n_pushes == N_PUSHES
    text = f"{OBJECT}: diagnosed effects"
    cell.until(lambda: "table_tilt" in cell.values("identification_node").get(text, ""))

    # The file of a diagnosis does the same; one that names nothing, or none at all, takes the effect out of the model again.
    file, content = tmp_path / "diagnosis.json", json.loads(report.json)
    file.write_text(json.dumps(content | {"effects": [{"name": "ghosts", "parameters": {}, "std": {}}]}))
    assert "no effect of this version" in cell.answer(str(file)).message
    away = {"x": -0.09, "y": 0.09}
    file.write_text(json.dumps(content | {"effects": [content["effects"][0] | {"name": "table_tilt", "parameters": away}]}))
    answer = cell.answer(str(file))
    assert not answer.success and "pushes of this model show table_tilt" in answer.message
    assert "table_tilt" in cell.values("identification_node")[text], "a wrong one changes nothing"
    assert cell.answer("").success
    cell.until(lambda: not effects_in_use(posterior_from_msg(cell.models[-1])[1]))
    file.write_text(json.dumps(content))
    answer = cell.answer(str(file))
    assert answer.success and "table_tilt" in answer.message, answer.message
    cell.until(lambda: len(effects_in_use(posterior_from_msg(cell.models[-1])[1])) == 1)
