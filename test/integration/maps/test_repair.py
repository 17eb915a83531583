"""A map with wrong closures that are believed is repaired with what the page shows (docs/repair.md)."""

import planted_closures
import pytest
from reliability import times

from graph_slam_ros import edit_run
from graph_slam_ros.runs.restore import restored
from graph_slam_ros.tools.report.contents import read_contents

WHO = {"who": "Anna", "when": "2026-05-04T10:30:00Z", "why": "the aisles look alike"}


@pytest.mark.parametrize("seed", times([0], [0, 1]))
def test_the_page_leads_to_every_wrong_closure_and_the_edited_map_is_as_good_as_a_clean_one(seed, tmp_path):
    run = tmp_path / "run"
    wrong = planted_closures.run(run, seed)
    planted_closures.run(tmp_path / "clean", seed, with_wrong=False)
    clean, before = planted_closures.error_m(tmp_path / "clean"), planted_closures.error_m(run)
    believed, others = wrong[:4], wrong[4:]
    assert len(wrong) == 12
    ledger = restored(run, []).view.ledger
    assert [ledger.is_inside(edge) for edge in wrong] == [True] * 4 + [False] * 8
    assert before > 2 * clean
    page = read_contents(run).data
    assert set(others) == set(page["charts"]["worst"][:8])
    true = [edge for edge in planted_closures.ends_of(run) if edge not in wrong]
    assert sorted(one["edges"] for one in page["groups"]) == sorted([sorted(believed), true])
    assert all(one["chi2"][1] < 0.5 * one["chi2"][0] and one["most"][1] > 1.0 for one in page["groups"])
    edits = [{"name": f"aisle-{edge}", **WHO, "do": "remove_edge", "edge": edge} for edge in wrong]
    effect = edit_run(run, edits[:4])
    assert effect.chi2[1] < 0.5 * effect.chi2[0]
    assert effect.moved[1] > 1.0
    assert effect.warnings == []
    edit_run(run, edits, tmp_path / "mended")
    assert planted_closures.error_m(tmp_path / "mended") <= 1.05 * clean
