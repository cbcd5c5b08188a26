from __future__ import annotations

from PIL import Image

from harness import readme_pictures
from harness.compare import Batch


def test_the_readmes_pictures_are_drawn_from_a_batch(monkeypatch, tmp_path):
    batch = Batch(("kinematic",), ("calibrated",), ("exp2", "circle"), ("none",), (0,))
    monkeypatch.setattr(readme_pictures, "BATCH", batch)
    monkeypatch.setattr(readme_pictures, "SHOWN", "kinematic-calibrated-circle-none-0")
    paths = list(readme_pictures.draw_pictures(tmp_path / "pictures"))
    assert [path.name for path in paths] == ["bench.png", "errors.png", "paths.png", "circle.png"]
    for path in paths:
        assert path.stat().st_size < 300e3
        with Image.open(path) as picture:
            assert picture.size[0] >= 900
