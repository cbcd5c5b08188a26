"""`servobench analyse` as a user meets it."""

from __future__ import annotations

import numpy as np
import pandas as pd

from kit.command import servobench


def test_loops_are_analysed_side_by_side(monkeypatch, capsys, tmp_path):
    arguments = ["pid+true", "mfac+ukf", "--out", str(tmp_path), "--set", "mfac+ukf.law.gain=60.0"]
    assert servobench(monkeypatch, "analyse", *arguments) == 0
    printed = capsys.readouterr().out
    assert "true Jacobian" in printed
    table = pd.read_csv(tmp_path / "analyse.csv").set_index("controller")
    assert table["stable"].tolist() == [True, False]
    assert np.isnan(table.loc["mfac+ukf", "gain_margin"])
    assert table.loc["mfac+ukf", "latency_limit_s"] == 0.0
    assert table.loc["pid+true", "latency_limit_s"] == table.loc["pid+true", "delay_margin_s"]
    page = (tmp_path / "analyse.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert "pid+true" in page
    figures = sorted(path.name for path in (tmp_path / "figures").iterdir())
    assert figures == ["loops.pdf", "loops.png", "stability_map.pdf", "stability_map.png"]


def test_every_loop_can_be_identified(monkeypatch, capsys, tmp_path):
    assert servobench(monkeypatch, "analyse", "pid+true", "--identify", "--out", str(tmp_path)) == 0
    assert "identified in small motions" in capsys.readouterr().out
    table = pd.read_csv(tmp_path / "analyse.csv")
    assert table["model"].tolist() == ["identified"]


def test_the_loop_of_another_arm_is_analysed(monkeypatch, tmp_path):
    tables = []
    for robot in ("ur5", "panda"):
        out = tmp_path / robot
        asked = ["broyden", "--jacobian", "nominal", "--mismatch", "moderate", "--robot", robot, "--out", str(out)]
        assert servobench(monkeypatch, "analyse", *asked) == 0
        tables.append(pd.read_csv(out / "analyse.csv"))
    margins = [table["delay_margin_s"].iloc[0] for table in tables]
    assert margins[1] > 0.0
    assert margins[0] != margins[1]
