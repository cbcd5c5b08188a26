"""`servobench analyse` as a user meets it."""

import numpy as np
import pandas as pd


def test_loops_are_analysed_side_by_side(output_of, tmp_path):
    arguments = ["pid+true", "mfac+ukf", "--out", str(tmp_path), "--set", "mfac+ukf.law.gain=60.0"]
    assert "true Jacobian" in output_of("analyse", *arguments)
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


def test_the_loop_of_another_arm_is_analysed_and_can_be_identified(
    output_of, monkeypatch, tmp_path
):
    monkeypatch.setattr(
        "servobench.harness.apps.loops.loop_pictures.write_pictures", lambda folder, *_: [folder]
    )
    margins = []
    for robot, how in (("ur5", ("--jacobian", "nominal")), ("panda", ("--identify",))):
        identified = "--identify" in how
        asked = [
            "pid+constant",
            "--mismatch",
            "moderate",
            "--robot",
            robot,
            "--out",
            str(tmp_path / robot),
            *how,
        ]
        assert ("identified in small motions" in output_of("analyse", *asked)) == identified
        table = pd.read_csv(tmp_path / robot / "analyse.csv")
        assert table["model"].tolist() == ["identified" if identified else "linearised"]
        margins.append(table["delay_margin_s"].iloc[0])
    assert 0.0 < margins[1] != margins[0]


def test_the_title_names_loops_that_are_identified(output_of, monkeypatch, tmp_path):
    monkeypatch.setattr(
        "servobench.harness.apps.loops.loop_pictures.write_pictures", lambda folder, *_: [folder]
    )
    own = "docs/examples/own_controller.py:ResolvedRate"
    printed = output_of("analyse", "pid+true", own, "--out", str(tmp_path))
    assert "the true Jacobian; identified in small motions: ResolvedRate" in " ".join(
        printed.split()
    )
