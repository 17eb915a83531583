"""Options that may be repeated: each of them counts, not only the last."""

import sys

import pytest

from graph_slam_ros.cli import main


def refused(monkeypatch, capsys, *words):
    monkeypatch.setattr(sys, "argv", ["graph_slam", *map(str, words)])
    try:
        code = main()
    except SystemExit as stop:
        code = stop.code
    return code, "".join(capsys.readouterr())


@pytest.mark.parametrize("words", (("warehouse", "--fault", "nonsense", "--fault", "wrong_ids"),))
def test_the_first_of_two_faults_is_not_forgotten(monkeypatch, capsys, tmp_path, words):
    code, said = refused(monkeypatch, capsys, "simulate", *words, "--out", tmp_path / "out")
    assert code == 2
    assert "nonsense" in said


def test_the_first_of_two_configurations_is_not_forgotten(monkeypatch, capsys, tmp_path):
    (tmp_path / "good.yaml").write_text("{}")
    (tmp_path / "bag.mcap").write_bytes(b"")
    words = ("--config", tmp_path / "missing.yaml", "--config", tmp_path / "good.yaml", "--out", tmp_path / "out")
    code, said = refused(monkeypatch, capsys, "fleet", "replay", tmp_path / "bag.mcap", *words)
    assert code == 2
    assert "missing.yaml" in said
