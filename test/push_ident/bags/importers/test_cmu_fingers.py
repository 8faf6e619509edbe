"""Logs of pushes with two fingers: what the importer finds in logs whose delay, camera and fingers are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from helpers.commands import check_refused, run_here
from helpers.finger_logs import CAMERA, DELAY, FINGERS, write_run
from push_ident.bags.importers import FingerOptions, import_cmu_fingers
from push_ident.bags.importers.cmu_fingers import Registration, published_shape, pushes_of_logs, registration_of
from push_ident.bags.pushes import split_pushes
from push_ident.bags.reader import read_bag
from push_ident.errors import BagError, InputError
from push_ident.geometry.outline import signed_distance
from push_ident.geometry.se2 import inverse, transform_points
from push_ident.types import Float64Array


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[Float64Array]]:
    folder = tmp_path_factory.mktemp("logs") / "bigrect_3pts"
    ends = [end for seed in range(3) for end in write_run(folder / f"run_{seed}" / f"log_{seed}.txt", seed)]
    return folder, ends


def test_contacts_of_the_fingers_give_delay_and_camera_back(logs: tuple[Path, list[Float64Array]]) -> None:
    found = registration_of(pushes_of_logs([logs[0]]), published_shape([next(logs[0].rglob("log*"))]))
    assert found.delay == pytest.approx(DELAY, abs=0.02)
    assert np.abs(np.array(found.camera) - CAMERA).max() < 4e-3 and np.abs(np.array(found.camera) - CAMERA)[:2].max() < 4e-4


def test_each_push_of_a_run_is_one_with_fingers_that_touch_and_its_true_end(logs: tuple[Path, list[Float64Array]], tmp_path: Path) -> None:
    options = FingerOptions(registration=Registration(DELAY, (0.0015, -0.001, 0.01)))
    report = import_cmu_fingers([logs[0]], tmp_path / "bag", options=options)
    contents = read_bag(report.bag)
    pushes = split_pushes(contents, "1")
    assert report.n_pushes == len(pushes) == 6 and not report.warnings
    for push, end in zip(pushes, logs[1], strict=True):
        # A yaw may be given in another turn.
        assert push.poses.pose[-1, :2] == pytest.approx(end[:2], abs=2e-5)
        assert np.cos(push.poses.pose[-1, 2] - end[2]) == pytest.approx(1.0, abs=1e-6)
        assert push.pusher.fingers is not None and push.pusher.yaw is not None
        assert push.pusher.fingers == pytest.approx(FINGERS, abs=1e-9)
        hand = np.array([*push.pusher.position[-1], push.pusher.yaw[-1]])
        tips = transform_points(inverse(push.poses.pose[-1]), transform_points(hand, FINGERS))
        assert signed_distance(tips, push.shape.outline).min() == pytest.approx(0.0025, abs=1e-4)
    ends_only = import_cmu_fingers([logs[0]], tmp_path / "ends", options=FingerOptions(ends_only=True))
    assert {len(push.poses.time) for push in split_pushes(read_bag(ends_only.bag), "1")} == {2}


def test_first_rows_that_still_show_the_run_before_are_left_out(logs: tuple[Path, list[Float64Array]], tmp_path: Path) -> None:
    file = next(logs[0].rglob("log_0.txt"))
    lines = file.read_text().splitlines()
    words = lines[0].split(",")
    stale_object = ",".join([f"{float(words[0]) - 0.03:.2f}", "200.0", "-100.0", "1.0", *words[4:]])
    # The number of the second push is set while the hand still stands at the end of the first.
    second = next(k for k, line in enumerate(lines) if line.endswith(",1"))
    stale_hand = lines[second - 1].rsplit(",", 1)[0] + ",1"
    copied = tmp_path / "bigrect" / "log_stale.txt"
    copied.parent.mkdir()
    copied.write_text("\n".join([stale_object, *lines[: second - 1], stale_hand, *lines[second:]]))
    for push, stale in zip(pushes_of_logs([file]), pushes_of_logs([copied]), strict=True):
        turns = np.round((stale[0, 3] - push[0, 3]) / (2.0 * np.pi))
        assert stale[[0, -1], 1:4] == pytest.approx(push[[0, -1], 1:4] + [0.0, 0.0, 2.0 * np.pi * turns], abs=1e-9)
        assert stale[0, 4:6] == pytest.approx(push[0, 4:6], abs=1e-9)


def test_what_is_no_such_log_is_refused(logs: tuple[Path, list[Float64Array]], tmp_path: Path) -> None:
    (tmp_path / "tri").mkdir()
    file = tmp_path / "tri" / "log.txt"
    for text, words in (
        ("1,2,3\n", "eight"),
        ("a,b\n", "expected lines of eight numbers"),
        ("", "eight"),
        ("1,2,3,4,5,6,7,nan\n", "eight"),
    ):
        file.write_text(text)
        with pytest.raises(BagError, match=words):
            import_cmu_fingers([file], tmp_path / "bag")
    for names, words in (((logs[0], file), "expected one object"), ((tmp_path / "nowhere",), "not published")):
        with pytest.raises(InputError, match=words):
            import_cmu_fingers(list(names), tmp_path / "bag")
    with pytest.raises(InputError, match="outline of butter"):
        import_cmu_fingers([file], tmp_path / "bag", options=FingerOptions(shape="butter"))
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match=r"no log\*\.txt"):
        import_cmu_fingers([tmp_path / "empty"], tmp_path / "bag")


def test_command_imports_logs_and_says_what_the_contacts_show(logs: tuple[Path, list[Float64Array]], tmp_path: Path) -> None:
    done = run_here("import", "cmu-fingers", str(logs[0]), "--out", str(tmp_path / "bag"))
    assert done.returncode == 0 and "6 pushes" in done.stdout and "so the fingers touch the object" in done.stdout
    assert "two fingers" in (tmp_path / "bag_import.html").read_text()
    butter = ("--shape", "butter", "--out", tmp_path / "other")
    check_refused("outline of butter", "import", "cmu-fingers", logs[0], *butter)
