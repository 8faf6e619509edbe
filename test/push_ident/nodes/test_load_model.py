"""Every path and every damaged model that identification_node is asked to load or save is answered with one line; right ones still work."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovarianceStamped

from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from helpers.node_process import Talker
from helpers.spinning import running
from helpers.wrong_poses import right_pose
from push_ident.errors import InputError, PushIdentError
from push_ident.files import write_whole
from push_ident.nodes.base.network import own_domain
from push_ident.nodes.base.paths import file_to_read, file_to_write
from push_ident.nodes.convert.messages import shape_to_msgs
from push_ident.nodes.identification.identification_node import IdentificationNode
from push_ident.types import CellGrid, ObjectShape
from push_ident_msgs.srv import LoadModel, PredictPush, SaveModel

NO_FILES = ["", " ", "a\0b", "\ud800.json", "~nobody_of_this_name/model.json", "n" * 300 + ".json", "/".join(["d" * 200] * 5) + ".json"]


def test_a_path_that_names_no_file_is_refused_in_one_line() -> None:
    for text in NO_FILES:
        with pytest.raises(InputError) as caught:
            file_to_read(text)
        assert str(caught.value).isprintable()
        with pytest.raises(PushIdentError):  # whether the file system has such names is seen when a file is written
            write_whole(file_to_write(text), "", "the model")


@pytest.mark.live
def test_no_path_and_no_damaged_model_breaks_the_services(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    paths = [*NO_FILES[:2], *NO_FILES[4:], *map(str, unreadable_paths(tmp_path).values())]
    models = [right_model() for _ in DAMAGE]
    for model, (change, _) in zip(models, DAMAGE.values(), strict=True):
        change(model)
    singular = right_model() | {"covariance": [[0.01] * len(right_model()["z"])] * len(right_model()["z"])}
    texts = [json.dumps(right_model()), *map(json.dumps, [*models, singular]), *(make() for make, _ in DAMAGED_TEXT.values())]
    for number, text in enumerate(texts):
        (tmp_path / f"{number}.json").write_text(text)
    paths += [str(tmp_path / f"{number}.json") for number in range(1, len(texts))]
    content = right_model()
    shape = ObjectShape(CellGrid(np.array(content["cells"]), content["cell_size"]), np.array(content["outline"]))
    domain = own_domain()
    with running(IdentificationNode, domain), Talker(domain) as talker:
        load = talker.node.create_client(LoadModel, "load_model")
        for name, msg in zip(("cells", "outline"), shape_to_msgs(shape, "o1", Time()), strict=True):
            talker.publish(type(msg), f"objects/o1/{name}", msg)
        pose = partial(talker.publish, PoseWithCovarianceStamped, "objects/o1/pose", right_pose())
        talker.until(lambda: int(talker.values().get("shapes") or 0) > 0, pose)
        for path in paths:
            answer = talker.ask(load, LoadModel.Request(object_id="o1", path=path))
            assert not answer.success and answer.message.isprintable() and answer.message, path
        answer = talker.ask(load, LoadModel.Request(object_id="o1", path=str(tmp_path / "0.json")))
        assert answer.success, answer.message
        save = talker.node.create_client(SaveModel, "save_model")
        for path in ("", " ", "/", "/gone/model.json", "\x00", "a" * 5000):
            answer = talker.ask(save, SaveModel.Request(object_id="o1", path=path))
            assert not answer.success and answer.message, path
        assert talker.ask(save, SaveModel.Request(object_id="o1", path=str(tmp_path / "model.json"))).success
        unnamed = PredictPush.Request(object_id="o1")
        unnamed.object_pose.pose.position.x = 0.1
        answer = talker.ask(talker.node.create_client(PredictPush, "predict_push"), unnamed)
        assert not answer.success and "`object_pose` has no frame_id" in answer.message
    assert "Traceback" not in capfd.readouterr().err
