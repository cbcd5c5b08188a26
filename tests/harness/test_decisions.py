"""What a batch is to decide, what its table decides, and which of its runs go on."""

import numpy as np
import pandas as pd
import pytest

from kit.folders import made_up_row
from servobench.harness.analysis.decisions import (
    EVERY,
    Question,
    answer_table,
    decide_worlds,
    needed_after,
)
from servobench.harness.batch.looks import in_looks
from servobench.harness.batch.plan import Batch, Cell
from servobench.plant.contract.faults import ConfigurationError

METHODS = ("ukf_mfac", "broyden", "rls")
TASKS = ("exp1", "exp2")
SEEDS = range(100, 180)


def requests(seeds=SEEDS):
    return Batch(("kinematic",), (*METHODS, "calibrated"), TASKS, ("moderate",), seeds).requests()


def runs_of(**shifts):
    """Return a table in which methods differ from the first one by so many margins [0.05 s] on exp1, by 5 on exp2."""
    rng = np.random.default_rng(1)
    rows = []
    for each in requests():
        shift = shifts.get(each.controller, 0.0)
        if each.task == "exp2":
            shift = 5.0 * METHODS.index(each.controller) if each.controller in METHODS else 0.0
        time = 2.0 + 0.05 * shift + rng.normal(0.0, 0.02)
        rows.append(made_up_row(**each.as_row(), settling_time_s=time))
    return pd.DataFrame(rows)


def test_all_methods_are_asked_about_or_one_and_each_other_and_bounds_if_named():
    names = ("calibrated", *METHODS)
    asked = Question.ask(names, None, 2, SEEDS)
    assert asked.pairs == (("ukf_mfac", "broyden"), ("ukf_mfac", "rls"), ("broyden", "rls"))
    assert asked.level == pytest.approx(0.05 / 6)
    assert asked.looks == [16, 32, 48, 64, 80]
    assert Question.ask(names, "rls", 1, range(20)).looks == [16, 20]
    against = Question.ask(names, "calibrated", 1, SEEDS).pairs
    assert against == tuple(("calibrated", name) for name in METHODS)


@pytest.mark.parametrize(
    ("names", "against", "seeds", "words"),
    [
        (("ukf_mfac", "calibrated"), None, SEEDS, "ukf_mfac, calibrated are too few"),
        (METHODS, "broyen", SEEDS, "--against: unknown 'broyen': did you mean 'broyden'"),
        (METHODS, None, range(15), "after every 16 seeds, .* got 15; give 200"),
    ],
)
def test_a_question_without_an_answer_is_refused_in_one_line(names, against, seeds, words):
    with pytest.raises(ConfigurationError, match=words):
        Question.ask(names, against, 1, seeds)


def test_each_pair_is_decided_in_each_world_at_its_first_look():
    question = Question.ask(METHODS, None, 2, SEEDS)
    answers = decide_worlds(runs_of(rls=0.5), question)
    assert [each.decision.verdict for each in answers] == ["equivalent"] * 3 + ["better"] * 3
    assert {each.decision.robots for each in answers[3:]} == {16}
    assert answers[0].margin == pytest.approx(0.05)
    table = answer_table(answers)
    assert list(table["A − B"][:2]) == ["ukf_mfac − broyden", "ukf_mfac − rls"]
    assert table["world"][0] == "exp1 on kinematic, moderate"
    assert float(table["mean clipped difference"][3]) == pytest.approx(-0.25, abs=0.02)
    assert list(table["verdict"]) == ["equivalent"] * 3 + ["better"] * 3


def test_only_runs_of_pairs_that_are_not_decided_go_on():
    question = Question.ask(METHODS, None, 2, SEEDS)
    runs = runs_of(rls=1.0)  # on exp1 it differs by the margin from both others
    seen = runs[runs["seed"] < SEEDS[0] + 64]
    goes_on = needed_after(decide_worlds(seen, question), question)
    needed = {(each.task, each.controller) for each in requests() if goes_on(each)}
    assert needed == {
        ("exp1", "ukf_mfac"),
        ("exp1", "broyden"),
        ("exp1", "rls"),
        ("exp1", "calibrated"),
    }
    decided = needed_after(decide_worlds(runs_of(), question), question)
    assert not any(map(decided, requests()))
    assert all(map(needed_after([], question), requests()))


def test_a_look_counts_once_both_methods_have_all_of_its_seeds():
    question = Question.ask(METHODS[:2], None, 1, SEEDS)
    runs = runs_of()
    runs = runs[(runs["task"] == "exp2")]
    lacking = runs[~((runs["controller"] == "broyden") & (runs["seed"] == SEEDS[20]))]
    (found,) = decide_worlds(lacking, question)
    assert found.decision.robots == EVERY
    lacking = runs[~((runs["controller"] == "broyden") & (runs["seed"] == SEEDS[3]))]
    (found,) = decide_worlds(lacking, question)
    assert found.decision.robots == 0
    whole, shuffled = (decide_worlds(each, question)[0] for each in (runs, runs.sample(frac=1.0)))
    assert whole.decision == shuffled.decision


def test_runs_come_look_by_look_in_ascending_seeds():
    seeds = (9, 3, 5, 1)
    cells = [Cell(each) for each in requests(seeds)]
    ordered, ends = in_looks(cells, sorted(seeds), [2, 4])
    assert ends == (16, 32)
    assert [each.request.seed for each in ordered[:4]] == [3, 1, 3, 1]
    assert {each.request.seed for each in ordered[16:]} == {5, 9}
    assert sorted(each.request.run_id for each in ordered) == sorted(
        each.request.run_id for each in cells
    )
