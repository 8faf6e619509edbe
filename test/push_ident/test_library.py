"""`import push_ident as pi`: short to print, and the same results as the command line."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
from IPython.core.formatters import HTMLFormatter
from threadpoolctl import threadpool_info, threadpool_limits

import push_ident as pi
from helpers.objects import hammer, random_records, square
from push_ident.api.calls import in_one_thread
from push_ident.bags.records import write_records
from push_ident.errors import InputError
from push_ident.geometry.cells import cell_error
from push_ident.identification.observing.observation import observe_push
from push_ident.identification.results.model_file import save_model
from push_ident.identification.results.posterior import prior_posterior
from push_ident.identification.results.result import Identification
from push_ident.identification.unknowns.prior import Prior
from push_ident.offline.loading import LoadedPushes

LONGEST_REPR = 400
"""A few lines of a terminal [characters]."""


@pytest.fixture(scope="module")
def pushes(tmp_path_factory: pytest.TempPathFactory) -> LoadedPushes:
    path = tmp_path_factory.mktemp("bags") / "hammer"
    write_records(path, random_records(hammer(2), 5, 2))
    return pi.load(path)


@pytest.fixture(scope="module")
def result(pushes: LoadedPushes) -> Identification:
    return pi.identify(pushes[:3])


def test_every_name_that_is_offered_exists_and_is_documented_and_typed() -> None:
    assert (Path(pi.__file__).parent / "py.typed").is_file()
    for name in pi.__all__:
        assert name == "__version__" or "Raises" in (getattr(pi, name).__doc__ or "") or name == "next_push", name
    with pytest.raises(AttributeError, match=r"no attribute 'identfy'; it offers check, diagnose"):
        pi.identfy  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize(("chosen", "used"), [(None, 1), ("2", 2)], ids=["by default", "as chosen"])
def test_linear_algebra_has_one_thread_during_a_call(chosen: str | None, used: int, monkeypatch: pytest.MonkeyPatch) -> None:
    if chosen is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", chosen)

    def threads() -> set[int]:
        return {found["num_threads"] for found in threadpool_info() if found["user_api"] == "blas"}

    with threadpool_limits(limits=2, user_api="blas"):
        before = threads()
        assert max(before) == 2  # a library that was built for one thread keeps it
        assert in_one_thread(threads)() == ({1} if used == 1 else before)
        assert threads() == before
    for call in (pi.identify, pi.predict, pi.diagnose, pi.next_push):
        assert hasattr(call, "__wrapped__"), f"{call.__name__} is no call of one thread"


def test_pushes_not_used_are_predicted_by_the_result_and_by_its_file(pushes: LoadedPushes, result: Identification, tmp_path: Path) -> None:
    assert len(pushes[1:3]) == 2 and pushes[1:3].object_id == pushes.object_id and pushes[1:3][0] is pushes[1]
    predicted = pi.predict(result, pushes[3:])
    assert len(predicted) == 2 and predicted.mean_cell_error < 0.004
    save_model(tmp_path / "model.json", result.posterior, object_id="1")
    again = pi.predict(tmp_path / "model.json", pushes[4])
    assert again[0].cell_error == pytest.approx(predicted[1].cell_error, abs=1e-6)


def test_push_that_was_not_made_is_predicted_as_the_same_push_when_it_is_recorded(
    pushes: LoadedPushes, result: Identification, tmp_path: Path
) -> None:
    recorded, pusher = pi.predict(result, pushes[3])[0], pushes[3].pusher
    given: dict[str, Any] = {"pose": observe_push(pushes[3]).pose[0], "radius": pusher.radius}
    rows = np.column_stack([pusher.time, pusher.position])
    (tmp_path / "path.csv").write_text("t,x_mm,y_mm\n" + "\n".join(f"{t},{1e3 * x},{1e3 * y}" for t, x, y in rows))
    for path in (rows, pusher, tmp_path / "path.csv"):
        planned = pi.predict(result, path=path, **given)
        assert cell_error(planned.shape.cells, planned.prediction.pose[-1], recorded.prediction.pose[-1]) < 5e-4
        assert planned.prediction.time[0] == pusher.time[0] and planned.prediction.touched == 1.0
        assert planned.prediction.cell_error_std == pytest.approx(recorded.prediction.cell_error_std, rel=0.5)
    assert len(repr(planned)) < LONGEST_REPR
    pi.plot(planned).savefig(tmp_path / "figure.png", dpi=40)


def test_chances_of_a_push_come_from_the_posterior(tmp_path: Path) -> None:
    shape = hammer(2).shape
    anything = prior_posterior(shape, Prior())
    low, right = shape.outline[:, 1].min(), shape.outline[:, 0].max()
    centre = pi.predict(anything, pose=(0, 0, 0), path=[[0.0, low - 0.02], [0.0, low + 0.1]], speed=0.1, radius=0.008)
    left_or_right = {float(np.sign(outcome.end[2])): outcome.chance for outcome in centre.outcomes}
    assert sorted(left_or_right) == [-1.0, 1.0] and sum(left_or_right.values()) == 1.0 and min(left_or_right.values()) > 0.2
    pi.plot(centre).savefig(tmp_path / "figure.png", dpi=40)
    touched = []
    for gap in (-0.003, 0.0, 0.0005, 0.003):  # first poses are known to 0.5 mm
        x = right + 0.008 + gap
        touched.append(pi.predict(anything, pose=(0, 0, 0), path=[[x, -0.1], [x, 0.1]], speed=0.1, radius=0.008).prediction.touched)
    assert touched[0] == 1.0 and 0.5 < touched[1] < 0.9 and 0.1 < touched[2] < 0.5 and touched[3] == 0.0


def test_given_total_mass_is_that_of_the_map(pushes: LoadedPushes) -> None:
    weighed = pi.identify(pushes[:3], total_mass=0.71)
    assert weighed.model.total_mass == pytest.approx(0.71) and weighed.posterior.total_mass_identifiable


def test_text_of_every_result_is_short_and_it_can_be_drawn(pushes: LoadedPushes, result: Identification, tmp_path: Path) -> None:
    proposal, predicted = pi.next_push(result, pushes[0].pusher.radius), pi.predict(result, pushes[3:])
    assert proposal is not None and proposal.error_after < proposal.error_before
    drawn = (pushes, pushes[0], result, result.posterior, predicted, proposal)
    for thing in (*drawn, pushes[0].shape, result.model, result.history[-1], predicted[0], result.candidates[0], result.warm_starts[0]):
        assert len(repr(thing)) < LONGEST_REPR and "\n" not in repr(thing), type(thing)
    for thing in drawn:
        pi.plot(thing, "Title $x$").savefig(tmp_path / "figure.png", dpi=40)
        assert (tmp_path / "figure.png").stat().st_size > 2000
    with pytest.raises(InputError, match="no figure of a ndarray"):
        pi.plot(np.zeros(3))


def test_tables_of_results_are_whole_and_escape_foreign_text(pushes: LoadedPushes, result: Identification) -> None:
    hostile = LoadedPushes("<script>", pushes.records, ["a <b>"])
    for thing in (hostile, result, pi.predict(result, pushes[3:])):
        html = HTMLFormatter()(thing)
        assert html is not None and "<script>" not in html
        ElementTree.fromstring(f"<div>{html}</div>")  # each element ends


def test_mistakes_are_answered_in_one_line(pushes: LoadedPushes, result: Identification) -> None:
    with pytest.raises(InputError, match="needs the path of a bag"):
        pi.load()
    with pytest.raises(InputError, match="no push to learn from"):
        pi.identify([])
    with pytest.raises(InputError, match="no push to predict"):
        pi.predict(result, [])
    with pytest.raises(InputError, match="predict bags that share the cells"):
        pi.predict(result, replace(pushes[0], shape=square()))
    line, start = [[0.5, 0.0], [0.6, 0.0]], (0.0, 0.0, 0.0)
    wrong: tuple[tuple[dict[str, Any], str], ...] = (
        ({"pose": start}, "`pose` and `path`"),
        ({"pushes": pushes, "pose": start, "path": line}, "not both"),
        ({"pose": (0.0, 0.0), "path": line, "speed": 0.1}, "three finite numbers"),
        ({"pose": start, "path": line}, "no times, expected either times or a speed"),
        ({"pose": start, "path": [[0.0, 0.5, 0.0], [1.0, 0.6, 0.0]], "speed": 0.1}, "leave out the speed"),
        ({"pose": start, "path": [[0.0, 0.5, 0.0], [0.0, 0.6, 0.0]]}, "increas"),
        ({"pose": start, "path": [[1, 2, 3, 4]]}, "rows of time, x, y"),
        ({"pose": start, "path": line, "speed": 0.0}, "above 0"),
        ({"pose": start, "path": line, "speed": 1e-5}, "at most 600 s"),
        ({"pose": start, "path": [[0.0, 0.0], [0.1, 0.0]], "speed": 0.1}, "inside the object"),
        ({"pose": start, "path": line, "speed": 0.1, "radius": 18.0}, "at most 1 m"),
    )
    for arguments, reason in wrong:
        with pytest.raises(InputError, match=reason):
            pi.predict(result, **arguments)
