"""Pictures that are drawn from many runs: those of the README, and the robustness map."""

from __future__ import annotations

from dataclasses import replace

from PIL import Image

import readme_pictures
from kit.command import servobench
from servobench.harness.batch import results
from servobench.harness.batch.compare import Batch
from servobench.harness.studies import robustness


def test_the_readmes_pictures_are_drawn_from_a_batch(monkeypatch, tmp_path):
    batch = Batch(("kinematic",), ("calibrated",), ("exp2", "circle"), ("none",), (0,))
    monkeypatch.setattr(readme_pictures, "BATCH", batch)
    monkeypatch.setattr(readme_pictures, "SHOWN", "kinematic-calibrated-circle-none-0")
    monkeypatch.setattr(readme_pictures, "MAP_CONTROLLERS", ("calibrated",))
    monkeypatch.setattr(readme_pictures, "MAP_SEEDS", range(2))
    monkeypatch.setattr(
        robustness, "LINES", [replace(robustness.LINES[4], places=robustness.LINES[4].places[:2]), robustness.LINES[-1]]
    )
    paths = list(readme_pictures.draw_pictures(tmp_path / "pictures"))
    names = ["bench", "errors", "paths", "circle", "robustness", "robustness_settling"]
    assert [path.stem for path in paths] == names
    for path in paths:
        assert path.stat().st_size < 300e3
        with Image.open(path) as picture:
            assert picture.size[0] >= 450


def test_the_command_draws_the_map(monkeypatch, tmp_path, capsys):
    out = tmp_path / "map"
    arguments = (
        "robustness", "--plant", "kinematic", "--controllers", "constant", "--seeds", "1", "--workers", "1",
        "--set", "random.duration=1", "--out", str(out),
    )  # fmt: skip
    assert servobench(monkeypatch, *arguments) == 0
    assert "the map is in" in capsys.readouterr().out
    assert len(results.load_runs(out / "moved")) == 5
    assert {path.name for path in (out / "figures").iterdir()} == {
        "robustness.png", "robustness.pdf", "robustness_settling.png", "robustness_settling.pdf",
    }  # fmt: skip
