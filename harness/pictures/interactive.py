"""What the report draws in the reader's browser: paths in space to be turned, and the error of every run over time.

Both are plain numbers, few enough for a page; `report.js` draws them.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from servobench.harness.analysis.measures import handy_unit
from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.pictures.style import MethodStyle, method_styles
from servobench.harness.pictures.tracks import Track, Tracks, each, label_of, load_groups, longest
from servobench.plant.contract.checks import FloatArray

MOST_POINTS = 150  # of a path; more cannot be told apart
MOST_VIEWS = 24  # plant, mismatch and task
CURVE_POINTS = (40, 160)  # of the error of a run: at least, at most
CURVE_BYTES = 1.2e6  # of all errors together
NUMBER_BYTES = 6  # of one number in the page
STEPS_AT_ONCE = 64  # runs whose steps are in memory at a time
DIGITS = 4  # significant, of a number in the page
DASHES = {"-": [], "--": [7, 4], "-.": [8, 3, 2, 3], ":": [2, 3]}  # px, of the named line styles

Json = dict[str, Any]


def swatches(names: list[str]) -> dict[str, Json]:
    """Return colour and dashes of each controller's line as the page draws it."""
    return {name: {"colour": style.colour, "dash": _dash(style)} for name, style in method_styles(names).items()}


def path_views(folder: Path) -> list[Json]:
    """Return the paths in space of each plant, mismatch and task; none where no run has one.

    Raises:
        ConfigurationError: not a results folder.
    """
    views = (
        _view(f"{task} on {group.plant}, mismatch {group.mismatch}, seed {group.seed}", tracks)
        for group in load_groups(folder)
        for task, tracks in group.tasks.items()
        if all(len(track.features) >= 3 for track in tracks.values())
    )
    return [view for view, _ in zip(views, range(MOST_VIEWS), strict=False)]


def error_curves(folder: Path, runs: pd.DataFrame) -> dict[str, Json]:
    """Return the true error of each run over time, by its identifier, as far as its steps are kept.

    Of many runs each has few points: each is the largest error of the periods for which it stands. Of more runs than
    fit into a page, the first ones have a curve.

    Args:
        folder: a results folder.
        runs: those wanted, in the order in which they matter.
    """
    least, most = CURVE_POINTS
    wanted = runs.head(int(CURVE_BYTES / (NUMBER_BYTES * least)))
    points = int(np.clip(CURVE_BYTES / (NUMBER_BYTES * max(1, len(wanted))), least, most))
    curves: dict[str, Json] = {}
    units = dict(zip(wanted["run_id"], wanted.reindex(columns=["feature_unit"])["feature_unit"], strict=True))
    for run_id, steps in _steps(folder, wanted["run_id"].tolist()):
        unit, factor = handy_unit(units[run_id])
        bins = np.array_split(factor * steps["error_norm"].to_numpy(dtype=np.float64), min(points, len(steps)))
        curves[run_id] = {
            "end": rounded(float(steps["time_s"].iloc[-1])),
            "unit": unit,
            "error": [rounded(float(np.nanmax(part))) if np.isfinite(part).any() else None for part in bins],
        }
    return curves


def rounded(value: float, digits: int = DIGITS) -> float | None:
    """Return a number with few digits, None where it is not finite: what JSON can hold."""
    return float(f"{value:.{digits}g}") if np.isfinite(value) else None


def _steps(folder: Path, run_ids: list[str]) -> Iterator[tuple[str, pd.DataFrame]]:
    if not results.has_steps(folder):
        return
    for first in range(0, len(run_ids), STEPS_AT_ONCE):
        try:
            steps = results.load_steps(
                folder, run_ids[first : first + STEPS_AT_ONCE], ["run_id", "time_s", "error_norm"]
            )
        except ConfigurationError:  # each of these runs ended before its first period
            continue
        for run_id, own in steps.groupby("run_id", sort=False):
            yield str(run_id), own


def _view(title: str, tracks: Tracks) -> Json:
    few = each(Track.for_path, tracks)
    whole = longest(few)
    reference = whole.vectors("reference_")[:, :3]
    still = whole.point_to_point
    return {
        "title": title,
        "axes": [label_of(name).replace("z [", "depth z [") for name in whole.features[:3]],
        "reference": _points(reference[:1] if still else reference),
        "start": _points(whole.vectors("true_feature_")[:1, :3]),
        "paths": {name: _points(track.vectors("true_feature_")[:, :3]) for name, track in few.items()},
    }


def _points(points: FloatArray) -> list[list[float | None]]:
    """Return points as rows of a few significant numbers."""
    step = max(1, -(-len(points) // MOST_POINTS))
    chosen = points[np.isfinite(points).all(axis=1)]
    kept = np.unique([*range(0, len(chosen), step), *([len(chosen) - 1] if len(chosen) else [])]).astype(int)
    return [[rounded(float(x)) for x in point] for point in chosen[kept]]


def _dash(style: MethodStyle) -> list[float]:
    if isinstance(style.line, str):
        return list(DASHES.get(style.line, []))
    return [2.0 * float(length) for length in style.line[1]]
