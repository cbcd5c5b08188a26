"""The pictures at the top of the README: one robot on rendered images."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from PIL import Image

from page_studies.methods import SIX
from page_studies.study import Study
from page_studies.worlds import small
from servobench.harness.batch import results
from servobench.harness.pictures.figures import folder_figures
from servobench.harness.pictures.film import draw_frame
from servobench.harness.pictures.replay import logged_run
from servobench.harness.pictures.style import picture_of

SHOWN = "circle"  # the task whose film gives a frame
PERIOD = 150  # of the run shown: three quarters of a lap
FILES = {"errors": "errors", "tracking": "circle", "paths": "paths"}  # kind of figure -> name of its file


def pictures(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield a frame of the film, errors, paths and the circle."""
    batch = folder / "batch"
    runs = results.load_runs(batch)
    first = runs[(runs["task"] == SHOWN)].iloc[0]
    row = {str(name): value for name, value in first.items()}
    frame = draw_frame(logged_run(row, results.load_steps(batch, [row["run_id"]]), {}), PERIOD)
    yield "pictures/bench.png", small(Image.fromarray(frame))
    for named in folder_figures(batch):
        if named.kind in FILES:
            yield f"pictures/{FILES[named.kind]}.png", picture_of(named.figure)[0]


README = Study(
    "readme",
    "the README's pictures of one robot on rendered images",
    6,
    {
        "batch": (
            "compare", "--plants", "bullet", "--controllers", ",".join((*SIX, "calibrated")),
            "--tasks", "exp1,exp2,exp3,exp4,circle", "--mismatch", "moderate", "--seeds", "0:1", "--no-report",
        ),
    },
    files=pictures,
)  # fmt: skip
