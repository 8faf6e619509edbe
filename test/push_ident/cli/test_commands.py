"""The command line as its users and their scripts see it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from helpers.commands import check_refused, run_here
from helpers.damaged_models import DAMAGE, DAMAGED_TEXT, right_model, unreadable_paths
from helpers.diagnosis import simulated_pushes
from helpers.objects import hammer, random_records, with_forces
from helpers.paths import EXAMPLE_BAG
from push_ident import __version__
from push_ident.bags.raw import raw_messages
from push_ident.bags.records import write_records
from push_ident.bags.writer import BagWriter
from push_ident.identification.results.model_file import save_model
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.unknowns.prior import Prior


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bags") / "hammer"
    write_records(path, random_records(hammer(2), 6, 2))
    return path


def test_identify_writes_what_the_contract_names_and_predicts_pushes_on_request(bag: Path, tmp_path: Path) -> None:
    done = run_here("identify", bag, "--train", "0,1", "--record", "--json", tmp_path / "r.json", "--out", tmp_path / "out")
    assert done.returncode == 0, done.stderr
    content = json.loads((tmp_path / "r.json").read_text())
    assert content["train"]["pushes"] == [0, 1] and content["test"]["pushes"] == [2, 3, 4, 5]
    assert content["test"]["identified_m"] < content["test"]["uniform_m"]
    assert all(len(values) == content["n_cells"] for values in content["map"].values())
    assert content["total_mass"]["identifiable"] is False
    assert {"model.json", "report.html", "result.json"} == {p.name for p in (tmp_path / "out").iterdir()}
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert "Predictions before each push" in page and "hammer push 1</code>" in page and "hammer push 0" not in page
    predicted = run_here("predict", tmp_path / "out" / "model.json", bag, "--json", tmp_path / "p.json")
    assert predicted.returncode == 0, predicted.stderr
    content = json.loads((tmp_path / "p.json").read_text())
    assert content["cell_error_m"] < 0.004 and [push["in_training"] for push in content["pushes"]] == [True, True] + [False] * 4
    errors = [push["cell_error_m"] for push in content["pushes"]]
    assert content["held_out_cell_error_m"] == pytest.approx(sum(errors[2:]) / 4)
    assert "over the 4 that the model was not fitted to" in predicted.stdout and "fitted to all" not in predicted.stderr


def test_push_that_was_not_made_is_predicted_from_a_pose_and_a_file(tmp_path: Path) -> None:
    model, path = tmp_path / "model.json", tmp_path / "path.csv"
    shape = hammer(2).shape
    save_model(model, prior_posterior(shape, Prior()), object_id="o1")
    path.write_text("x_mm,y_mm\n0,-90\n0,50\n")
    push = ("--path", path, "--radius", "8mm", "--json", tmp_path / "p.json")
    done = run_here("predict", model, "--pose", "0,0,0deg", "--speed", "10cm/s", *push)
    assert done.returncode == 0 and done.stdout.count("with a chance of") == 3, done.stderr
    content = json.loads((tmp_path / "p.json").read_text())
    trajectory = content["trajectory"]
    assert content["pusher_radius_m"] == 0.008 and content["touched"] == 1.0 and len(content["outcomes"]) == 2
    assert content["end"] == trajectory["pose"][-1] and content["covariance"] == trajectory["covariance"][-1]
    assert len(trajectory["time_s"]) == len(trajectory["pose"]) and trajectory["time_s"][-1] == pytest.approx(1.9)
    path.write_text("time,x,y\n0,0.3,-0.1\n1,0.3,0.1\n")
    done = run_here("predict", model, "--pose", "0,0,0", *push)
    assert done.returncode == 0 and "touched with a chance of 0%" in done.stdout
    content = json.loads((tmp_path / "p.json").read_text())
    assert content["status"] == "no_contact" and content["end"] == [0.0, 0.0, 0.0]
    for options, reason in (
        ((), "say what to predict"),
        (("--pose", "0,0,0"), "say what to predict"),
        ((EXAMPLE_BAG, "--pose", "0,0,0", "--path", path), "say what to predict"),
        ((EXAMPLE_BAG, "--radius", "8mm"), "say what to predict"),
        (("--radius", "8mm"), "say what to predict"),
        (("--pose", "0,0,90", "--path", path), "90deg is 1.571 rad"),
        (("--pose", "0,0,0", "--path", path, "--speed", 0.1), f"{path}: The path of the pusher has times"),
        (("--pose", "0,0,0", "--path", tmp_path / "none.csv"), "cannot be read"),
    ):
        check_refused(reason, "predict", model, *options)


def test_pushes_and_forces_are_left_out_on_request(tmp_path: Path) -> None:
    bag, maps = tmp_path / "hammer", []
    write_records(bag, [with_forces(record, hammer(2)) for record in random_records(hammer(2), 6, 2)])
    for number, options in enumerate((("--without", "1,3-5", "--no-forces"), ("--train", "0,2", "--without", "5"), ("--train", "0,2"))):
        done = run_here("identify", bag, *options, "--out", tmp_path / str(number))
        content = json.loads((tmp_path / str(number) / "result.json").read_text())
        assert done.returncode == 0 and content["train"]["pushes"] == [0, 2], done.stderr
        assert content["test"]["pushes"] == ([], [1, 3, 4], [1, 3, 4, 5])[number]
        maps.append(content["map"]["mass_friction"])
        sources = json.loads((tmp_path / str(number) / "model.json").read_text())["sources"]
        assert sources == ["hammer push 1", "hammer push 3"]
        assert ("push 5 is left out by --without: hammer push 6" in content["notes"]) == (number < 2) == ("left out" in done.stderr)
    assert maps[0] != maps[1] == maps[2], "the forces of the first one are left out"
    done = run_here("diagnose", bag, "--without", "0-2,4", "--no-forces", "--out", tmp_path / "d")
    assert done.returncode == 0 and "forces of 6 pushes are left out" in done.stderr
    page = (tmp_path / "d" / "report.html").read_text(encoding="utf-8")
    assert [f"<code>hammer push {number}</code>" in page for number in range(1, 7)] == [False, False, False, True, False, True]
    for command, reason in (
        (("identify", bag, "--without", "6"), "--without names push 6, but there are 6 pushes, 0 to 5."),
        (("identify", bag, "--train", "0,6"), "--train names push 6, but there are 6 pushes, 0 to 5."),
        (("identify", bag, "--without", "0-5"), "names all 6 pushes"),
        (("identify", bag, "--train", "0-2", "--without", "2,4"), "both name push 2"),
        (("diagnose", bag, "--without", "3-6"), "--without names push 6"),
        (("diagnose", bag, "--without", "x"), "such as 0,2,5-7"),
    ):
        check_refused(reason, *command)


def test_recording_is_diagnosed_against_another_one(tmp_path: Path) -> None:
    """Of the same object, on the same sloping table."""
    bags = [tmp_path / name for name in ("now", "before")]
    for bag, seed in zip(bags, (12, 11), strict=True):
        write_records(bag, simulated_pushes(5, seed, {"table_tilt": [0.03, 0.0]}))
    done = run_here("diagnose", bags[0], "--against", bags[1], "--json", tmp_path / "d.json", "--out", tmp_path / "out")
    content = json.loads((tmp_path / "d.json").read_text())
    assert done.returncode == 0 and "No change since the reference is found" in done.stdout
    assert content["verdict"] == "no_gap" and content["shared_with_reference"] == ["table_tilt"] and content["causes"] == []
    assert content["remainder_m"] < 1e-3 and content["motion"]["after_m"] < 2e-3
    assert (
        "no change since the reference" in (tmp_path / "out" / "report.html").read_text() and not (tmp_path / "out" / "model.json").exists()
    )


def test_bag_cut_in_half_is_refused_until_it_is_salvaged_and_what_cannot_be_done_is_said_in_one_line(bag: Path, tmp_path: Path) -> None:
    cut = tmp_path / "cut"
    with BagWriter(cut, chunk_size=4096) as writer:  # small chunks, as a long recording has them
        for message in raw_messages(bag):
            writer.write_raw(message.topic, message.msgtype, message.stamp_ns, message.data)
    (file,) = cut.glob("*.mcap")
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    for command, reason in (
        (("identify", cut), "salvage"),
        (("replay", cut), "salvage"),
        (("diagnose", tmp_path / "absent"), "no such bag"),
        (("identify", bag, "--train", "0,17"), "names push 17"),
    ):
        check_refused(reason, *command)
    assert run_here("salvage", cut, "--out", tmp_path / "saved").returncode == 0
    assert run_here("identify", tmp_path / "saved").returncode == 0


def test_version_is_that_of_the_package() -> None:
    assert run_here("--version").stdout.split() == ["push-ident", __version__]


@pytest.mark.parametrize(("command", "more"), [("predict", (EXAMPLE_BAG,)), ("export", ("--format", "mjcf"))], ids=["predict", "export"])
def test_damaged_models_and_paths_that_are_none_are_refused(command: str, more: tuple[object, ...], tmp_path: Path) -> None:
    """All damages: `identification/test_damaged_files.py`."""
    content = right_model()
    DAMAGE["cell twice"][0](content)
    texts = (json.dumps(content), *(DAMAGED_TEXT[name][0]() for name in ("NaN", "control characters in a name", "text")))
    for number, text in enumerate(texts):
        (tmp_path / f"text{number}.json").write_text(text)
    for path in (*unreadable_paths(tmp_path).values(), *tmp_path.glob("text*.json")):
        check_refused("push-ident: ", command, path, *more)


def test_names_that_are_too_long_and_exports_over_the_model_are_one_line_and_a_link_is_replaced(tmp_path: Path) -> None:
    long, model, link = tmp_path / ("n" * 253), tmp_path / "model.xml", tmp_path / "other.xml"
    long.write_text(json.dumps(right_model()))
    model.write_text(long.read_text())
    link.hardlink_to(model)
    for command, reason in (
        (("export", long, "--format", "mjcf"), "File name too long"),
        (("export", model, "--format", "mjcf", "--out", tmp_path / ("o" * 300)), "File name too long"),
        (("predict", model, tmp_path / ("b" * 300)), "there is no such bag"),
        (("export", model, "--format", "mjcf"), "is the model itself"),
        (("export", model, "--format", "mjcf", "--out", link), "is the model itself"),
    ):
        check_refused(reason, *command)
    loop = unreadable_paths(tmp_path)["loop of links"]
    done = run_here("export", model, "--format", "mjcf", "--out", loop)
    assert done.returncode == 0 and loop.read_text().startswith("<?xml")  # a link is replaced, not followed
