"""The pictures that the README shows, from committed seeds: `make figures`."""

from __future__ import annotations

import io
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from PIL import Image

from servobench.harness.batch import results
from servobench.harness.batch.campaign import Execution, carry_out, comparison
from servobench.harness.batch.compare import Batch
from servobench.harness.config.settings import Settings
from servobench.harness.pictures.draw import folder_figures, picture_of
from servobench.harness.pictures.film import draw_frame
from servobench.harness.pictures.replay import logged_run
from servobench.harness.studies.robustness import make_map

BATCH = Batch(
    plants=("bullet",),
    controllers=("rbfnn_mfac_plus", "rbfnn_mfac", "ukf_mfac", "ukf_mpc", "rbf_pid", "calibrated"),
    tasks=("exp1", "exp2", "exp3", "exp4", "circle"),
    mismatches=("moderate",),
    seeds=(0,),
)
SHOWN = "bullet-rbfnn_mfac_plus-circle-moderate-0"
PERIOD = 150  # of the run shown: three quarters of a lap
FILES = {"errors": "errors", "tracking": "circle", "paths": "paths"}  # kind of figure -> name of its file
MAP_CONTROLLERS = BATCH.controllers[:5]
MAP_SEEDS = range(50_000, 50_030)
COLOURS = 128  # of the rendered picture's palette


def draw_pictures(folder: Path) -> Iterator[Path]:
    """Draw the pictures into a folder and yield each file."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix="servobench-") as scratch:
        batch = Path(scratch) / "batch"
        carry_out(comparison(BATCH, Settings()), batch, Execution(workers=1))
        yield _write(folder / "bench.png", _bench(batch))
        for named in folder_figures(batch):
            if named.kind in FILES:
                yield _write(folder / f"{FILES[named.kind]}.png", picture_of(named.figure)[0])
        for path in make_map(Path(scratch) / "map", "fmu", MAP_CONTROLLERS, MAP_SEEDS, Settings(), Execution()):
            if path.suffix == ".png":
                with Image.open(path) as picture:
                    yield _write(folder / path.name, _small(picture.convert("RGB")))


def _bench(batch: Path) -> bytes:
    """Return a frame of the film of a run as PNG."""
    runs = results.load_runs(batch)
    row = {str(name): value for name, value in runs[runs["run_id"] == SHOWN].iloc[0].items()}
    frame = draw_frame(logged_run(row, results.load_steps(batch, [SHOWN]), {}), PERIOD)
    return _small(Image.fromarray(frame))


def _small(picture: Image.Image) -> bytes:
    """Return a picture as PNG with a palette."""
    stream = io.BytesIO()
    picture.quantize(COLOURS, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


def _write(path: Path, content: bytes) -> Path:
    path.write_bytes(content)
    return path


if __name__ == "__main__":
    for made in draw_pictures(Path(sys.argv[1])):
        sys.stdout.write(f"{made}: {made.stat().st_size / 1000:.0f} kB\n")
