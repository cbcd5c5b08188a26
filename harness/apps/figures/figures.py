"""All figures of a results folder, from its tables alone."""

import textwrap
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pandas as pd
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import split_tasks
from servobench.harness.analysis.folder import titled_runs
from servobench.harness.apps.figures.measures import (
    FIGURES,
    draw_conditions,
    draw_measures,
)
from servobench.harness.apps.figures.paths import draw_paths
from servobench.harness.apps.figures.responses import (
    draw_features,
    draw_jacobians,
    draw_joint_motion,
    draw_moves,
    draw_tracking,
)
from servobench.harness.apps.figures.style import (
    TEXT,
    WIDE,
    Layout,
    Styles,
    divisions,
    figure_style,
    method_styles,
    save_figure,
)
from servobench.harness.apps.figures.tracks import (
    Group,
    Tasks,
    load_ensembles,
    load_groups,
    longest,
    shown_until,
)
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.shares import WHOLE, Share, in_shares
from servobench.harness.run.request import UNFIT_FOR_FILES
from servobench.plant.contract.facts import read_beside

FOLDER = "figures"
LETTERS = 15.0  # letters of a title in an inch
TASKS_A_FIGURE = 4  # also blocks of paths
FIRST = "first seed"
EACH = "each seed"


class Kind(NamedTuple):
    """A kind of figure, for `run`, the report and `figures` alike."""

    heading: str
    seeds: str  # FIRST, EACH, or "median and band over seeds"
    in_page: bool = True  # whether the report shows it


KINDS = {name: Kind(**kind) for name, kind in read_beside(__file__, "kinds.toml").items()}


class NamedFigure(NamedTuple):
    """A figure with its name and heading."""

    kind: str  # one of KINDS
    stem: str  # name of its file without ending
    title: str  # the heading, and the place and seeds of its runs
    tasks: tuple[str, ...]  # the tasks that it shows; empty if it shows all
    figure: Figure
    number: int  # its place among the figures of a folder


@dataclass(frozen=True)
class Choice:
    """The figures that are wanted of a folder, and their appearance."""

    kinds: Collection[str] = tuple(KINDS)  # some of KINDS
    # Controllers that are shown, with their names in the figures; None for all.
    names: Mapping[str, str] | None = None
    # Layouts of each figure; with a narrow one they show tasks one by one.
    layouts: tuple[Layout, ...] = (WIDE,)
    title: bool = True  # whether the figures have titles


class Order(NamedTuple):
    """Which figures are drawn, and into which files."""

    folder: ResultsFolder
    target: Path  # folder of the files
    choice: Choice = Choice()
    formats: Sequence[str] = ("png",)
    exact_width: bool = False  # as for `save_figure`


def draw_figures(order: Order) -> list[Path]:
    """Draw figures into files, several at a time, and return the files.

    Raises:
        ConfigurationError: not a results folder.
    """
    drawn = in_shares(_draw_share, order)
    return [order.target / name for _, names in drawn for name in names]


def _draw_share(order: Order, share: Share) -> Iterator[tuple[int, list[str]]]:
    """Draw a share of the figures; yield the number of each and the names of its files."""
    for named in folder_figures(order.folder, order.choice, share):
        stem = order.target / named.stem
        made = save_figure(named.figure, stem, order.formats, exact_width=order.exact_width)
        yield named.number, [path.name for path in made]


def folder_figures(
    folder: ResultsFolder, choice: Choice = Choice(), share: Share = WHOLE
) -> Iterator[NamedFigure]:
    """Yield the chosen figures of a results folder, one in memory at a time; a figure in all layouts before the next.

    Raises:
        ConfigurationError: not a results folder.
    """
    runs = titled_runs(folder)
    styles = method_styles(runs["controller"].tolist())
    if choice.names is not None:
        runs = runs[runs["controller"].isin(list(choice.names))]
        runs = runs.assign(controller=runs["controller"].map(choice.names))
        styles = {shown: styles[name] for name, shown in choice.names.items()}
    wide = all(layout.wide for layout in choice.layouts)
    plans = _folder_plans(folder, runs, styles, TASKS_A_FIGURE if wide else 1, choice.kinds)
    for number, (group, plan) in share.of(plans):
        for layout in choice.layouts:
            named = _carry_out(group, plan, number, layout, title=choice.title)
            if named is not None:
                yield named


class _Plan(NamedTuple):
    """A figure that can be drawn."""

    kind: str
    part: str  # names of its tasks, where those of a group need more than one figure
    tasks: tuple[str, ...]
    draw: Callable[[Layout], Figure | None]


def _folder_plans(
    folder: ResultsFolder, runs: pd.DataFrame, styles: Styles, size: int, kinds: Collection[str]
) -> Iterator[tuple[Group, _Plan]]:
    """Yield the figures of some kinds, each with at most `size` tasks, with the group of runs that it shows."""
    if len(runs) > 1 and "conditions" in kinds:
        everything = Group("", "", runs, int(runs["seed"].min()), {})
        moves, _ = split_tasks(runs)
        yield everything, _Plan("conditions", "", (), partial(draw_conditions, moves, styles))
    for group in load_groups(folder, runs):
        for plan in _plans(group, load_ensembles(folder, group.runs), styles, size):
            if plan.kind in kinds:
                yield group, plan


def _carry_out(
    group: Group, plan: _Plan, number: int, layout: Layout, *, title: bool
) -> NamedFigure | None:
    """Return a figure with its name and heading."""
    heading = KINDS[plan.kind].heading
    place = f"{group.plant}, mismatch {group.mismatch}" if group.plant else ""
    details = ", ".join(filter(None, (plan.part, place, _sample(plan.kind, group))))
    with figure_style(TEXT):
        figure = plan.draw(layout)
        if figure is None:
            return None
        if title:
            letters = round(LETTERS * figure.get_figwidth())
            wrapped = [textwrap.fill(heading, letters), textwrap.fill(details, letters)]
            figure.suptitle("\n".join(wrapped), fontsize=TEXT + 1.0)
    for axes in figure.axes:
        # To lay a panel out, each spine computes the ticks again; labels reach beyond all but those at the bottom
        axes.spines[["left", "right", "top"]].set_in_layout(False)
    words = "_".join(filter(None, (plan.kind, plan.part, group.plant, group.mismatch)))
    return NamedFigure(
        kind=plan.kind,
        stem=UNFIT_FOR_FILES.sub("_", words),
        title=f"{heading}: {details}",
        tasks=plan.tasks,
        figure=figure,
        number=number,
    )


def _sample(kind: str, group: Group) -> str:
    """Return words for the seeds that a figure shows, and how."""
    seeds = group.runs["seed"].nunique()
    how = KINDS[kind].seeds
    if how == FIRST or seeds == 1:
        return f"seed {group.seed}"
    # In an unfinished batch some controllers have fewer seeds than others.
    least = int(group.runs.groupby(["controller", "task"])["seed"].nunique().min())
    count = f"{least} to {seeds} seeds" if least < seeds else f"{seeds} seeds"
    if how == EACH:
        return count
    words = f"median of {count}, band: the middle 80 %"
    if kind == "tracking":
        return f"{words}; errors in features of seed {group.seed}"
    return words


def _plans(group: Group, ensembles: Tasks, styles: Styles, size: int) -> Iterator[_Plan]:
    """Yield the figures of a group: of its moves, of its curves, and of both."""
    moves = {task: tracks for task, tracks in group.tasks.items() if longest(tracks).point_to_point}
    runs = group.runs
    everything = tuple(group.tasks)
    until = {task: shown_until(ensembles[task]) for task in everything}
    for text, part in _parts(moves, size):
        over_seeds = {task: ensembles[task] for task in part}
        of_first_seed = {task: moves[task] for task in part}
        yield _Plan("errors", text, part, partial(draw_moves, over_seeds, styles))
        yield _Plan("features", text, part, partial(draw_features, of_first_seed, until, styles))
    heads = divisions(name for tracks in moves.values() for name in tracks)
    for text, part in _parts(moves, max(1, size // len(heads))):
        of_first_seed = {task: moves[task] for task in part}
        yield _Plan("paths", text, part, partial(draw_paths, of_first_seed, styles))
    for task, tracks in group.tasks.items():
        if task not in moves:
            draw = partial(draw_tracking, ensembles[task], tracks, styles)
            yield _Plan("tracking", task, (task,), draw)
            yield _Plan("tracking_path", task, (task,), partial(draw_paths, {task: tracks}, styles))
    yield _Plan("jacobian", "", everything, partial(draw_jacobians, ensembles, styles))
    if len(runs) > 1:  # the row of a single run in the table of runs says it all
        for text, part in _parts(runs["task"].unique(), size):
            chosen = runs[runs["task"].isin(part)]
            for kind in FIGURES:
                yield _Plan(kind, text, part, partial(draw_measures, chosen, kind, styles))
    for task, tracks in group.tasks.items():
        yield _Plan("joint_speeds", task, (task,), partial(draw_joint_motion, tracks, until[task]))


def _parts(tasks: Iterable[str], size: int) -> Iterator[tuple[str, tuple[str, ...]]]:
    """Yield tasks in parts for a figure each, with words for the part where there are several."""
    names = tuple(tasks)
    for first in range(0, len(names), size):
        part = names[first : first + size]
        yield "" if len(names) <= size else "-".join(part), part
