"""Every path and every damaged model that identification_node is asked to load or save is answered with one line; right ones still work."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid
from sensor_msgs.msg import JointState

from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from helpers.executor_cell import BOX
from helpers.node_process import Talker
from helpers.spinning import spinning
from helpers.wrong_poses import right_pose, wrong_poses
from push_ident.errors import InputError, PushIdentError
from push_ident.files import write_whole
from push_ident.geometry.outline import cells_in_outline
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.base.paths import file_to_read, file_to_write
from push_ident.nodes.convert.messages import shape_to_msgs
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.types import CellGrid, ObjectShape
from push_ident_msgs.msg import PushRecord
from push_ident_msgs.srv import LoadModel, SaveModel

NO_FILES = ["", " ", "a\0b", "\ud800.json", "~nobody_of_this_name/model.json", "n" * 300 + ".json", "/".join(["d" * 200] * 5) + ".json"]


def shape_of(content: dict[str, Any]) -> ObjectShape:
    return ObjectShape(CellGrid(np.array(content["cells"]), content["cell_size"]), np.array(content["outline"]))


@pytest.mark.parametrize("text", NO_FILES, ids=range(len(NO_FILES)))
def test_a_path_that_names_no_file_is_refused_in_one_line(text: str) -> None:
    with pytest.raises(InputError) as caught:
        file_to_read(text)
    assert str(caught.value).isprintable()
    with pytest.raises(PushIdentError):  # whether the file system has such names is seen when a file is written
        write_whole(file_to_write(text), "", "the model")


@pytest.fixture(scope="module")
def talker() -> Iterator[Talker]:
    """Beside identification_node."""
    domain = own_domain()
    with spinning(lambda context: IdentificationNode(context=context), domain) as node, Talker(domain) as talker:
        yield talker
        node.close()


def publish_object(talker: Talker, object_id: str, shape: ObjectShape) -> None:
    cells, outline = shape_to_msgs(shape, object_id, Time())
    talker.publish(OccupancyGrid, f"objects/{object_id}/cells", cells)
    talker.publish(PolygonStamped, f"objects/{object_id}/outline", outline)
    n_shapes = int(talker.values().get("shapes") or 0)

    def publish_pose() -> None:
        talker.publish(PoseWithCovarianceStamped, f"objects/{object_id}/pose", right_pose())

    talker.until(lambda: int(talker.values().get("shapes") or 0) > n_shapes, publish_pose)


@pytest.mark.live
def test_no_path_and_no_damaged_model_breaks_the_service(talker: Talker, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    paths = [*NO_FILES[:2], *NO_FILES[4:], *map(str, unreadable_paths(tmp_path).values())]
    for number, (change, _) in enumerate(DAMAGE.values()):
        content = right_model()
        change(content)
        (tmp_path / f"damaged{number}.json").write_text(json.dumps(content))
        paths.append(str(tmp_path / f"damaged{number}.json"))
    for number, (make, _) in enumerate(DAMAGED_TEXT.values()):
        (tmp_path / f"text{number}.json").write_text(make())
        paths.append(str(tmp_path / f"text{number}.json"))
    singular = right_model()
    singular["covariance"] = [[0.01] * len(singular["z"])] * len(singular["z"])
    for name, model in (("right", right_model()), ("singular", singular)):
        (tmp_path / f"{name}.json").write_text(json.dumps(model))
    paths.append(str(tmp_path / "singular.json"))
    load = talker.node.create_client(LoadModel, "load_model")
    publish_object(talker, "o1", shape_of(right_model()))
    for path in paths:
        answer = talker.ask(load, LoadModel.Request(object_id="o1", path=path))
        assert not answer.success and answer.message.isprintable() and answer.message, path
    answer = talker.ask(load, LoadModel.Request(object_id="o1", path=str(tmp_path / "right.json")))
    assert answer.success, answer.message
    assert "Traceback" not in capfd.readouterr().err


@pytest.mark.live
def test_what_cannot_be_is_refused_and_a_model_is_saved_to_a_path_that_is_one(
    talker: Talker, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    publish_object(talker, "o2", ObjectShape(cells_in_outline(BOX, 0.01), BOX))
    for wrong in wrong_poses().values():
        talker.publish(PoseWithCovarianceStamped, "objects/o2/pose", wrong)
    talker.publish(PushRecord, "push_record", PushRecord(end=Time(sec=-1)))
    talker.publish(JointState, "joint_states", JointState())
    talker.until(lambda: int(talker.values().get("poses refused", 0)) >= len(wrong_poses()))
    assert int(talker.values()["refused"]) > len(wrong_poses())
    save = talker.node.create_client(SaveModel, "save_model")
    for path in ("", " ", "/", "/gone/model.json", "\x00", "a" * 5000):
        answer = talker.ask(save, SaveModel.Request(object_id="o2", path=path))
        assert not answer.success and answer.message, path
    assert talker.ask(save, SaveModel.Request(object_id="o2", path=str(tmp_path / "model.json"))).success
    talker.until(lambda: talker.values().get("kernels") == "loaded", timeout=300.0)  # they may have to be compiled first
    assert "Traceback" not in capfd.readouterr().err
