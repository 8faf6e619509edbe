"""`push-ident experiment live`: its measures on numbers that are known; the processes themselves run in the experiment."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from builtin_interfaces.msg import Time

from helpers.objects import hammer, random_records
from push_ident.errors import PushIdentError
from push_ident.identification.online.session import ObjectSession, SessionOptions
from push_ident_sim.studies.common.experiment import Case, CaseResult, Json
from push_ident_sim.studies.common.live_nodes import microseconds
from push_ident_sim.studies.live import study as live
from push_ident_sim.studies.live.film import delays
from push_ident_sim.studies.live.replay import difference, differing, growth


def test_growth_is_that_after_the_warm_up_and_one_outlier_changes_nothing() -> None:
    time = np.linspace(0.0, 3600.0, 200)
    memory = 150.0 + 2.0 * time / 3600.0 + np.where(time < 300.0, -80.0, 0.0)
    memory[120] += 40.0
    slope = growth(time, memory)
    assert slope is not None and slope[0] == pytest.approx(2.0, abs=0.01)
    assert slope[1] <= slope[0] <= slope[2]
    assert growth(time[:2], memory[:2]) is None


def test_delay_counts_frames_from_the_touch_to_the_end_of_the_push_and_those_without_a_map() -> None:
    came = {number * 100_000: 10.0 + 0.1 * number for number in range(20)}
    mapped = {number * 100_000: 10.02 + 0.1 * number for number in (3, 4, 6, 7, 15)}
    found = delays(came, mapped, [(0.0, 0.8)])
    # Frames 3 to 8; of them 5 and 8 have no map, and 15 is of no push.
    assert (found["frames"], found["with_map"]) == (6, 4)
    assert found["median_s"] == pytest.approx(0.02)
    with pytest.raises(PushIdentError, match="No frame"):
        delays(came, {}, [(0.0, 0.8)])


def test_stamp_survives_the_conversion_to_seconds() -> None:
    assert microseconds(Time(sec=12, nanosec=34_000_001)) == microseconds(Time(sec=12, nanosec=33_999_999)) == 12_034_000


def test_difference_is_in_standard_deviations_and_distinguishes_equal_from_nearly_equal(tmp_path: Path) -> None:
    truth = hammer(3)
    first, second = random_records(truth, 2, 3)
    session = ObjectSession("o1", first.shape, SessionOptions())
    session.finish(first)
    one = session.posterior
    assert difference(one, one) == {"deviations": 0.0, "relative": 0.0, "equal": True}
    session.finish(second)
    assert not (found := difference(session.posterior, one))["equal"] and found["deviations"] > 0.01


def test_values_that_differ_are_named_and_nan_equals_itself() -> None:
    one = {"model": {"z": [1.0], "version": "1"}, "scores": [float("nan")], "gone": 1}
    assert differing(one, {"model": {"z": [1.5], "version": "1"}, "scores": [float("nan")]}) == ["gone", "model.z"]


def test_summary_counts_kills_and_losses_and_is_shown(tmp_path: Path) -> None:
    kill: Json = {"equal": True, "differing": [], "half_written": False, "left": [], "deviations": 0.0, "relative": 0.0}
    kills = [kill, kill | {"equal": False, "differing": ["scores"], "half_written": True, "deviations": 0.2}]
    messages = {"poses": 100, "pusher samples": 300, "wrenches": 200}
    counts = {"poses": "100", "pusher samples": "299", "pushes": "8"}
    soak: Json = {
        "bag_s": 60.0,
        "rate": 5.0,
        "n_pushes": 8,
        "messages": messages,
        "counts": counts,
        "time_s": [0.0, 5.0],
        "node_mb": [150.0, 151.0],
        "player_mb": [90.0, 90.0],
        "late_s": [0.02],
        "most_waiting": 1,
        "node_growth_mb_h": [1.0, 0.5, 1.5],
        "player_growth_mb_h": None,
        "exit_code": 0,
        "end_s": 0.3,
        "traceback": False,
    }
    results = [CaseResult(Case("hammer", 0, "kills"), {"kills": kills}), CaseResult(Case("hammer", 0, "soak"), soak)]
    summary = live.STUDY.summarise(results)
    assert (summary["kills"]["equal"], summary["kills"]["half_written"], summary["kills"]["differing"]) == (1, 1, ["scores"])
    assert live.lost(messages, counts) == {"poses": 0, "pusher samples": 1, "wrenches": 200}
    text = live.STUDY.tables(summary)
    assert "| 1 of 2 |" in text and "600, 201" in text
    assert list(live.STUDY.draw(summary, tmp_path)) == ["live.png"] and (tmp_path / "live.png").exists()
