"""`load_model` answers every path and every damaged model with one line, and still takes a right one afterwards."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PolygonStamped, PoseWithCovarianceStamped
from nav_msgs.msg import OccupancyGrid

from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from helpers.node_process import NodeProcess, Talker
from helpers.wrong_poses import right_pose
from push_ident.errors import InputError, PushIdentError
from push_ident.files import write_whole
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.base.paths import file_to_read, file_to_write
from push_ident.nodes.convert.messages import shape_to_msgs
from push_ident.types import CellGrid, ObjectShape
from push_ident_msgs.srv import LoadModel

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


@pytest.mark.live
def test_no_path_and_no_damaged_model_breaks_the_service(tmp_path: Path) -> None:
    domain = own_domain()
    process = NodeProcess("identification_node", "push_ident.nodes", {}, domain, tmp_path)
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
    try:
        with Talker(domain) as talker:
            load = talker.node.create_client(LoadModel, "load_model")
            cells, outline = shape_to_msgs(shape_of(right_model()), "o1", Time())
            talker.publish(OccupancyGrid, "objects/o1/cells", cells)
            talker.publish(PolygonStamped, "objects/o1/outline", outline)
            talker.until(
                lambda: talker.values().get("shapes"), lambda: talker.publish(PoseWithCovarianceStamped, "objects/o1/pose", right_pose())
            )
            for path in paths:
                answer = talker.ask(load, LoadModel.Request(object_id="o1", path=path))
                assert not answer.success and answer.message.isprintable() and answer.message, path
            answer = talker.ask(load, LoadModel.Request(object_id="o1", path=str(tmp_path / "right.json")))
            assert answer.success, answer.message
        assert process.stop() == 0
    finally:
        process.stop()
    assert "Traceback" not in process.output
