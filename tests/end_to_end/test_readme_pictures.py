from __future__ import annotations

from PIL import Image

from servobench.harness.batch.compare import Batch
from servobench.harness.studies import readme_pictures, robustness


def test_the_readmes_pictures_are_drawn_from_a_batch(monkeypatch, tmp_path):
    batch = Batch(("kinematic",), ("calibrated",), ("exp2", "circle"), ("none",), (0,))
    monkeypatch.setattr(readme_pictures, "BATCH", batch)
    monkeypatch.setattr(readme_pictures, "SHOWN", "kinematic-calibrated-circle-none-0")
    monkeypatch.setattr(readme_pictures, "MAP_CONTROLLERS", ("calibrated",))
    monkeypatch.setattr(readme_pictures, "MAP_SEEDS", range(2))
    monkeypatch.setattr(robustness, "LINES", [robustness.Line("latency", "latency", ("0", "1")), robustness.LINES[-1]])
    paths = list(readme_pictures.draw_pictures(tmp_path / "pictures"))
    names = ["bench", "errors", "paths", "circle", "robustness", "robustness_settling"]
    assert [path.stem for path in paths] == names
    for path in paths:
        assert path.stat().st_size < 300e3
        with Image.open(path) as picture:
            assert picture.size[0] >= 450
