"""The suite: methods over challenges, judged against references that know the true robot.

A challenge is a part of the results folder. On each robot the better of its references bounds the others:

    score = min(1, max(reference, floor) / max(own, floor)),   0 for a lost run

A run is lost if it does not settle, on a curve if it is not followed, in a sequence if one of the later moves does not
settle. A challenge whose references both lose more than `MAX_REFERENCE_LOSS` of the robots bounds nothing: it has no
grade and no part in the ranking.
"""

from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from servobench.harness.analysis.comparison import (
    column_of,
    completed,
    margin,
    median_with_interval,
    outcomes,
    success_rate,
)
from servobench.harness.analysis.decisions import (
    DECISIONS,
    EVERY,
    Answer,
    Question,
    answer,
    answer_table,
)
from servobench.harness.analysis.tables import Cell, Row, Tables, as_plain, as_text
from servobench.harness.apps.figures import style
from servobench.harness.apps.studies.audit import mark_solved
from servobench.harness.apps.studies.challenge import MEASURES, Challenge
from servobench.harness.apps.studies.scores import profile, ranking, resolution, scores
from servobench.harness.batch.campaign import Campaign, Execution, carry_out_parts, check_effects
from servobench.harness.batch.plan import Cell as Run
from servobench.harness.cli.deciding import ending_when_decided, print_answers
from servobench.harness.config.registry import DECLARED, offered
from servobench.harness.config.settings import Settings
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import ACHIEVED
from servobench.harness.run.own_metrics import declare_metrics
from servobench.harness.run.request import UNFIT_FOR_FILES
from servobench.harness.run.resolution import check_settings, resolve_sections, select
from servobench.plant.contract.files import write_csv

MAX_REFERENCE_LOSS = 0.05
SEEING = "nmpc_calibrated"  # reference that sees the images of all methods
RUNS = "scores.csv"
METHODS = "methods.csv"
RANKING = "ranking.csv"
PICTURE = "suite"
FACTORS = (1.1, 2.0, 10.0)  # times the best method of a run, of the profile in the table
DRAWN_FACTORS = tuple(np.geomspace(1.0, 100.0, 81).tolist())


def carry_out_suite(
    out: Path,
    challenges: Sequence[Challenge],
    runs: Mapping[str, Sequence[Run]],
    settings: Settings,
    how: Execution,
    metrics: tuple[str, ...] = (),
    question: Question | None = None,
    *,
    on_tuning_seeds: bool = False,
) -> pd.DataFrame:
    """Carry out the runs of challenges, judge them, write tables and pictures, and return the judged runs.

    Args:
        out: folder of the suite; each challenge has its own in it.
        challenges: the worlds.
        runs: of each challenge by its name, references included.
        settings: overrides of the defaults of methods and worlds.
        how: how the runs are carried out.
        metrics: names of metrics of users, which are shown beside the scores.
        question: what is to be decided; None for all runs.
        on_tuning_seeds: whether robots are those on which methods were tuned, for an audit.

    Raises:
        ConfigurationError: settings that nothing reads or that a challenge fixes, or as `carry_out_parts`.
    """
    requests = [run.request for own in runs.values() for run in own]
    names = [name for each in requests for name in (each.plant, each.controller, each.task)]
    check_settings(settings, names)
    for cells in runs.values():
        check_effects(settings, [cell.request for cell in cells], steps=False)
    seeing = {SEEING: {"image": True, **settings.sections.get(SEEING, {})}}
    whole = Settings({**settings.sections, **seeing}, filed=settings.filed)
    for cells in runs.values():  # all challenges are checked before the first one runs
        requests = [cell.request for cell in cells]
        sections = resolve_sections(requests, whole)
        for request in requests:
            select(request, sections)
    campaigns = {
        name: Campaign(own, whole, metrics=metrics, on_tuning_seeds=on_tuning_seeds)
        for name, own in runs.items()
    }
    if question is not None:
        for each in challenges:
            find = partial(challenge_answers, each)
            campaigns[each.name] = ending_when_decided(campaigns[each.name], question, find)
    tables = carry_out_parts(campaigns, out, how)
    declare_metrics({each.name: each.entry.record() for each in offered(metrics)})
    parts = []
    answers = []
    for each in challenges:
        judged = judge(each, tables[each.name])
        if question is not None:
            answers += challenge_answers(each, tables[each.name], question)
            judged = shared_robots(judged, each)
        parts.append(judged)
    if question is not None:
        budget = sum(map(len, runs.values()))
        print_answers(answers, question, sum(map(len, tables.values())), budget)
        write_csv(answer_table(answers), out / DECISIONS)
    judged = mark_solved(pd.concat(parts, ignore_index=True), challenges)
    write_csv(judged, out / RUNS)
    _write_rows(methods_rows(judged), out / METHODS)
    _write_rows(ranking_rows(judged), out / RANKING)
    for _, own in bounded(judged).groupby("plant", sort=False):
        draw_suite(own, out)
    return judged


def _write_rows(rows: list[Row], path: Path) -> None:
    """Write rows as plain values, an estimate in a column for each of its numbers."""
    write_csv(pd.json_normalize(as_plain(rows)), path)


def challenge_answers(challenge: Challenge, runs: pd.DataFrame, question: Question) -> list[Answer]:
    """Return what the runs of a challenge decide, by its measure; runs that are lost there are lost here."""
    measure = MEASURES[challenge.measure]
    judged = judge(challenge, runs)
    judged = judged.assign(value=judged["value"].fillna(np.inf), run_id=runs["run_id"])
    answers = []
    for plant, place in judged.groupby("plant", sort=False):
        own = runs.loc[place.index]
        at_first = own[own["seed"].isin(question.seeds[:EVERY])]
        small = measure.factor * margin(measure.column, at_first)
        words = f"{challenge.name} on {plant}"
        answers += answer(place, words, f"{challenge.measure} [{measure.unit}]", small, question)
    return answers


def shared_robots(judged: pd.DataFrame, challenge: Challenge) -> pd.DataFrame:
    """Return the runs of a challenge on the robots that all methods met, though some may have ended before others."""
    methods = judged[~judged["controller"].isin(challenge.reference)]
    met = methods.groupby(["plant", "seed"])["controller"].nunique()
    kept = met.index[met == met.groupby("plant").transform("max")]
    robots = pd.MultiIndex.from_frame(judged[["plant", "seed"]])
    return judged[robots.isin(kept)]


def judge(challenge: Challenge, runs: pd.DataFrame) -> pd.DataFrame:
    """Return the runs of a challenge with their scores.

    Returns:
        A row a run: challenge, grade, plant, controller, seed; `measured` in the unit that is shown, NaN where there is
        none; `value`, the same raised to the floor and NaN of a lost run; `score`, NaN where no reference ran;
        `reference`, the value of the better one, NaN where it is lost; `solved`, still empty, see `mark_solved`.
    """
    measure = MEASURES[challenge.measure]
    floor = measure.factor * measure.floor
    measured = measure.factor * completed(runs, measure.column)
    value = measured
    if measure.whole:
        value = measured.where(outcomes(runs).isin(ACHIEVED))
    value = value.clip(lower=floor)
    robots = pd.MultiIndex.from_frame(runs[["plant", "seed"]])
    is_reference = runs["controller"].isin(challenge.reference)
    best = value[is_reference].groupby([runs["plant"], runs["seed"]]).min()
    reference = best.reindex(robots).to_numpy()
    has_reference = robots.isin(best.index)
    return runs[["plant", "controller", "seed"]].assign(
        challenge=challenge.name,
        title=challenge.title,
        grade=challenge.grade.name,
        measure=challenge.measure,
        measured=measured,
        value=value,
        reference=reference,
        solved="",
        score=np.where(has_reference, scores(value, reference, floor), np.nan),
        **{name: column_of(runs, name) for name in DECLARED},
    )


def bounded(judged: pd.DataFrame) -> pd.DataFrame:
    """Return the scored runs of methods that were in all challenges of worth.

    Those are not solved by a shortcut, and their references lose few robots.
    """
    known = judged[judged["score"].notna() & (judged["solved"] == "")]
    lost = known.groupby(["challenge", "plant"])["reference"].transform(
        lambda own: own.isna().mean()
    )
    kept = known[lost <= MAX_REFERENCE_LOSS]
    count = kept.groupby(["plant", "controller"])["seed"].transform("size")
    # A reference may be in some of them only
    return kept[count == count.groupby(kept["plant"]).transform("max")]


def methods_rows(judged: pd.DataFrame) -> list[Row]:
    """Return a row for each challenge, plant and method, best first: its good runs, median, lost runs, mean score."""
    rows = []
    for _, place in judged.groupby(["challenge", "plant"], sort=False):
        best = place[place["score"].notna()].drop_duplicates("seed")["reference"]
        facts = place.iloc[0]
        about = {
            name: Cell(str(facts[name])) for name in ("challenge", "grade", "plant", "measure")
        }
        about["reference"] = Cell(median_with_interval(best).value, ".2f")
        about["reference_lost"] = Cell(100.0 * float(best.isna().mean()), ".1f")
        means = place.groupby("controller", sort=False)["score"].mean()
        for name, score in means.sort_values(ascending=False, kind="stable").items():
            own = place[place["controller"] == name]
            count = int(own["value"].notna().sum())
            good = success_rate(count, len(own)).scaled(100.0)
            row = {
                **about,
                "controller": Cell(str(name)),
                "runs": Cell(float(len(own)), ".0f"),
                "good": Cell(good, ".0f"),
                "median": Cell(median_with_interval(own["measured"]), ".2f"),
                "lost": Cell(100.0 - good.value, ".0f"),
                "score": Cell(float(score), ".2f"),
            }
            for metric in DECLARED:
                row[metric] = Cell(float(own[metric].median()), f".{METRICS[metric].digits}f")
            rows.append(row)
    return rows


def ranking_rows(judged: pd.DataFrame) -> list[Row]:
    """Return a row for each plant and method: rank, interquartile mean of its scores, lost runs and profile."""
    rows = []
    for plant, own in bounded(judged).groupby("plant", sort=False):
        shares = profile(own, FACTORS)
        for each in ranking(own):
            row = {
                "plant": Cell(str(plant)),
                "controller": Cell(each.controller),
                "rank": Cell(each.rank),
                "score": Cell(each.score, ".2f"),
                "lost, %": Cell(100.0 * each.lost, ".1f"),
            }
            for factor, share in zip(FACTORS, shares[each.controller], strict=True):
                row[f"within {factor:g}×"] = Cell(float(share), ".2f")
            rows.append(row)
    return rows


def suite_tables(judged: pd.DataFrame) -> Tables:
    """Yield titles and tables of text: one for each challenge and plant, and the ranking on each plant."""
    titles = dict(zip(judged["challenge"], judged["title"], strict=True))
    rows = as_text(methods_rows(judged))
    for (name, plant), place in rows.groupby(["challenge", "plant"], sort=False):
        about = place.iloc[0]
        measure = MEASURES[about["measure"]]
        is_here = (judged["challenge"] == name) & (judged["plant"] == plant)
        scored = judged[is_here & judged["score"].notna()]
        grade = about["grade"] or "ungraded"
        if len(scored) > 0 and bounded(scored).empty:
            grade = "no grade, as its references fail"
        shortcut = judged.loc[is_here, "solved"].iloc[0]
        if shortcut:
            grade = f"no grade, as {shortcut} solves it"
        headings = {
            "controller": "controller",
            "runs": "runs",
            "good": f"{measure.achieved}, %",
            "median": f"median, {measure.unit}",
            "lost": "lost, %",
            "score": "score",
            **{name: f"{name}, {METRICS[name].unit}" for name in DECLARED},
        }
        title = (
            f"{name!s} ({grade}) on {plant!s}: {titles[name]}; reference {about['reference']} {measure.unit}, "
            f"lost {about['reference_lost']} %"
        )
        yield title, place[list(headings)].rename(columns=headings)
    if ranks := ranking_rows(judged):
        count = rows["challenge"].nunique()
        for plant, place in as_text(ranks).groupby("plant", sort=False):
            own = bounded(judged[judged["plant"] == plant])
            title = f"ranking on {plant!s} over {own['challenge'].nunique()} of {count}"
            if own.groupby("challenge")["seed"].nunique().min() > 1:
                apart = f"{resolution(own):.3f}".replace("0.000", "less than 0.001")
                title += f"; halves of the robots differ by {apart} in the score"
            yield title, place.drop(columns="plant")


def draw_suite(runs: pd.DataFrame, folder: Path) -> list[Path]:
    """Draw performance profiles and the mean score of each method in each challenge; return the files.

    Args:
        runs: bounded judged runs of one plant.
        folder: folder of the files, which the plant names.
    """
    means = runs.pivot_table("score", "controller", "challenge", sort=False)
    means = means.loc[[each.controller for each in ranking(runs)]]
    shares = profile(runs, DRAWN_FACTORS)
    styles = style.method_styles(means.index)
    plant = runs["plant"].iloc[0]
    with style.figure_style(style.TEXT):
        heights = (2.2, 0.9 + 0.19 * len(means))
        figure = Figure(figsize=(style.WIDTH, sum(heights) + 0.9), layout="constrained")
        top, bottom = figure.subplots(2, 1, height_ratios=heights)
        for name in means.index:
            look = styles[name].line_arguments(len(shares))
            top.plot(shares.index, shares[name], label=name, **look)
        style.plain_logarithms(top, "x")
        top.set(xlabel="times the best method of the run", ylabel="share of runs", ylim=(0.0, 1.02))
        top.set_title(f"Runs within a factor of the best, and mean scores, on {plant}")
        _draw_scores(bottom, means)
        style.add_legend(figure, [top])
    return style.save_figure(figure, folder / UNFIT_FOR_FILES.sub("_", f"{PICTURE}_{plant}"))


def _draw_scores(axes: Axes, means: pd.DataFrame) -> None:
    """Draw a cell for each method and challenge; dark is good."""
    # The scale ends beyond 1, so that dark text is readable on every cell.
    axes.imshow(means, cmap="Blues", vmin=0.0, vmax=1.3, aspect="auto")
    for (row, column), score in np.ndenumerate(means.to_numpy()):
        axes.text(column, row, f"{score:.2f}", ha="center", va="center", fontsize=style.TEXT - 2.0)
    axes.set_xticks(range(means.shape[1]), means.columns, rotation=40.0, ha="right")
    axes.set_yticks(range(len(means)), means.index)
    axes.grid(visible=False)
