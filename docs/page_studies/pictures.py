"""Studies that write no table: the README's pictures of one robot on rendered images, and the page of performance."""

from __future__ import annotations

import io
from base64 import b64decode
from pathlib import Path

from PIL import Image

from page_studies.study import FIVE, Study
from servobench.harness.apps.figures.figures import Choice, folder_figures
from servobench.harness.apps.figures.style import drawing_of
from servobench.harness.apps.films.film import draw_frame
from servobench.harness.apps.films.replay import logged_run
from servobench.harness.batch import results
from servobench.harness.batch.results import ResultsFolder

SHOWN = "circle"  # the task whose film gives a frame
PERIOD = 150  # of the run shown: three quarters of a lap
# Kind of figure -> name of its file
FILES = {"errors": "errors", "tracking": "circle", "paths": "paths"}
COLOURS = 128  # of a picture's palette


def small(picture: Image.Image) -> bytes:
    """Return a picture as PNG with a palette."""
    stream = io.BytesIO()
    picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(
        stream, "PNG", optimize=True
    )
    return stream.getvalue()


def readme_pictures(folder: Path) -> dict[str, bytes]:
    """Return a frame of the film, errors, paths and the circle."""
    batch = folder / "batch"
    runs = results.load_runs(batch)
    row = {str(name): value for name, value in runs[runs["task"] == SHOWN].iloc[0].items()}
    frame = draw_frame(logged_run(row, results.load_steps(batch, [row["run_id"]])), PERIOD)
    figures = {
        f"pictures/{FILES[named.kind]}.png": b64decode(drawing_of(named.figure).data)
        for named in folder_figures(ResultsFolder(batch), Choice(tuple(FILES)))
    }
    return {"pictures/bench.png": small(Image.fromarray(frame))} | figures


def performance_page(folder: Path) -> dict[str, bytes]:
    """Return the page, which a script of its own measures and writes, and its pictures."""
    out = folder / "page"
    paths = (out / "performance.md", *sorted((out / "pictures").glob("*.png")))
    return {path.relative_to(out).as_posix(): path.read_bytes() for path in paths}


README = Study(
    "readme",
    "the README's pictures of one robot on rendered images",
    6,
    {
        "batch": (
            "compare", "--plants", "bullet", "--controllers", ",".join((*FIVE, "calibrated")),
            "--tasks", "exp1,exp2,exp3,exp4,circle", "--mismatch", "moderate", "--seeds", "0:1", "--no-report",
        ),
    },
    files=readme_pictures,
)  # fmt: skip
PERFORMANCE = Study(
    "performance",
    "the page of performance",
    20,
    {"page": ("benchmarks/page.py",)},
    files=performance_page,
)
