"""The sentence with which a report begins, of runs whose result is known."""

import numpy as np
import pandas as pd

from kit.folders import made_up_row
from servobench.harness.analysis.verdict import judge, knows_truth, leaders


def runs_of(seeds: int, **times: float) -> pd.DataFrame:
    """Return moves of controllers that settle after about these times; NaN never settles."""
    rows = [
        made_up_row(
            f"{name}-{seed}", controller=name, seed=seed, settling_time_s=time + 0.01 * seed
        )
        for name, time in times.items()
        for seed in range(seeds)
    ]
    return pd.DataFrame(rows)


def test_one_run_is_told_as_one_run():
    verdict = judge(runs_of(1, mine=1.5))
    assert verdict.result.startswith(
        "`mine` settled in exp1 on kinematic after 1.50 s, with an error of 1.0 mm"
    )
    assert verdict.cautions == ("One run says nothing about other seeds.",)


def test_one_run_that_did_not_succeed_says_what_came_of_it():
    lost = runs_of(1, mine=np.nan).assign(outcome="joint_at_limit")
    assert judge(lost).result.startswith(
        "`mine` did not settle in exp1 on kinematic (joint_at_limit): it ended with"
    )
    crashed = lost.assign(status="crashed", outcome="crashed")
    assert judge(crashed).result == "`mine` ended exp1 on kinematic early: crashed."
    curve = runs_of(1, mine=np.nan).assign(task_kind="curve", task="circle")
    assert judge(curve).result == "`mine` followed circle on kinematic with an RMS error of 2.0 mm."


def test_one_controller_is_told_with_intervals():
    result = judge(runs_of(10, mine=1.0)).result
    assert result.startswith(
        "`mine` settled in 10 of 10 runs (95 % interval: 72 to 100 %), after a median of 1.04 s (95"
    )
    assert judge(runs_of(1, mine=1.5, calibrated=1.0)).result.endswith("after a median of 1.50 s.")
    rarely = runs_of(4, mine=np.nan).assign(settling_time_s=[1.0, *3 * [np.nan]])
    assert judge(rarely).result == "`mine` settled in 1 of 4 runs (95 % interval: 5 to 70 %)."


def test_with_few_seeds_the_order_is_a_hint():
    verdict = judge(runs_of(5, a=1.0, b=2.0))
    assert verdict.result == "Both controllers settled in every run."
    assert verdict.cautions[0].startswith("5 seeds are too few to tell the two controllers apart")
    assert "at least 6)" in verdict.cautions[0]
    unfinished = judge(pd.concat([runs_of(8, a=1.0), runs_of(2, b=2.0)]))
    assert unfinished.cautions[0].startswith("2 seeds are too few")


def test_places_with_few_seeds_are_shown_beside_those_that_are_judged():
    many = runs_of(8, a=1.0, b=2.0)
    once = runs_of(1, a=2.0, b=1.0).assign(plant="bullet")
    verdict = judge(pd.concat([many, once]))
    assert "`a` is best in `exp1 on kinematic, moderate`" in verdict.result
    assert "bullet" not in verdict.result
    few = "Shown, not judged, with fewer than 6 seeds: `exp1 on bullet, moderate`."
    assert few in verdict.cautions
    assert not any("not judged" in each for each in judge(many).cautions)


def test_the_first_sentence_names_the_best_and_by_how_much():
    result = judge(runs_of(8, a=1.0, b=2.0)).result
    assert result == "`a` is best: 1.00 s ahead of `b` in settling time."


def test_the_first_sentence_names_all_that_are_practically_equal_or_undecided():
    verdict = judge(runs_of(8, a=1.0, b=2.0, c=1.01))
    assert (
        verdict.result
        == "`a` and `c` are best: equal within 0.05 s, and `a` is 1.00 s ahead of `b` in settling time."
    )
    assert verdict.cautions[0] == "All 3 controllers settled in every run."
    runs = runs_of(8, a=1.0, b=2.0, d=1.0)
    runs.loc[runs["controller"] == "d", "settling_time_s"] += [
        0.0,
        0.5,
        0.0,
        0.3,
        0.0,
        0.0,
        0.4,
        0.0,
    ]
    assert (
        judge(runs).result
        == "`a` is first: 1.00 s ahead of `b` in settling time, undecided against `d`."
    )


def test_places_with_the_same_winners_share_a_clause_and_others_have_their_own():
    near, far = runs_of(8, a=1.0, b=2.0), runs_of(8, a=1.0, b=3.0).assign(task="exp2")
    circle = runs_of(8, a=np.nan, b=np.nan).assign(task="circle", task_kind="curve")
    circle["rms_error_evaluated"] = np.where(circle["controller"] == "a", 0.004, 0.002)
    assert judge(pd.concat([near, far, circle])).result == (
        "`a` is best in `exp1` and `exp2`: 1.00 to 2.00 s ahead of `b` in settling time; "
        "`b` is best in `circle`: 2.00 mm ahead of `a` in RMS error of the judged part."
    )


def test_where_nothing_differs_nobody_is_first():
    verdict = judge(runs_of(20, a=1.0, b=1.0, c=1.0))
    assert verdict.result == "`a`, `b` and `c` are best: equal within 0.05 s in settling time."
    assert verdict.cautions[1:] == ("The success rates do not differ significantly.",)


def test_the_least_and_the_most_reliable_are_named_with_their_runs():
    verdict = judge(runs_of(12, good=1.0, bad=np.nan))
    assert verdict.result == "`good` is best, losing fewer runs than `bad`."
    assert verdict.cautions[0].startswith(
        "`good` settled in 12 of 12 runs (95 % interval: 76 to 100 %)"
    )
    assert "least often `bad`, in 0 of 12 runs (95 % interval: 0 to 24 %)." in verdict.cautions[0]
    assert verdict.cautions[1:] == (
        "`bad` succeeds significantly less often than `good` (sign test over seeds).",
    )


def test_where_nothing_succeeds_nobody_is_praised():
    assert (
        judge(runs_of(3, a=np.nan, b=np.nan)).result
        == "None of the 2 controllers settled in any of 6 runs."
    )


def test_a_bound_that_knows_the_truth_is_not_ranked():
    verdict = judge(runs_of(8, calibrated=0.5, a=1.0, b=2.0))
    assert "`calibrated` knows the true robot: shown, not ranked." in verdict.cautions
    assert "calibrated" not in verdict.result
    assert "calibrated" not in leaders(runs_of(8, calibrated=0.5, a=1.0, b=2.0)).to_string()
    assert knows_truth("pid+true")
    assert not knows_truth("ukf_mfac")


def test_a_third_partys_controller_is_not_loaded_to_write_a_report():
    assert not knows_truth("./no_such_file.py:Mine")
    assert not knows_truth("no_such_law+true")


def test_runs_that_ended_early_are_counted():
    runs = runs_of(2, a=1.0, b=1.0)
    runs.loc[0, ["status", "outcome"]] = "crashed"
    assert "1 of 4 runs ended early." in judge(runs).cautions


def test_who_came_first_is_told_with_those_that_are_not_shown_to_be_behind():
    runs = pd.concat([runs_of(9, a=1.0, b=2.0), runs_of(9, c=1.0)])
    (row,) = leaders(runs).to_dict("records")
    assert row["First", "controller"] == "a"
    assert row["First", "median"].startswith("1.04 s [")
    assert row["How sure", "not shown to be behind the first"] == "c"
    assert leaders(runs[runs["controller"] == "a"]).empty


def test_the_first_by_one_run_is_not_said_to_beat_those_that_are_faster():
    runs = runs_of(30, reliable=2.0, fast=1.0, slow=3.0)
    runs.loc[
        (runs["controller"] != "reliable") & (runs["seed"] == 0), ["settling_time_s", "outcome"]
    ] = np.nan, "lost"
    (row,) = leaders(runs).to_dict("records")
    assert (row["First", "controller"], row["Next", "controller"]) == ("reliable", "fast")
    assert row["How sure", "not shown to be behind the first"] == "fast"
    lead = "`reliable` is best: 1.00 s ahead of `slow` in settling time, though `fast` had less settling time."
    assert judge(runs).result == lead
    assert judge(runs).cautions[1:] == ("The success rates do not differ significantly.",)


def test_errors_of_different_units_are_in_no_common_range():
    curves = runs_of(8, a=np.nan, b=np.nan).assign(task_kind="curve", task="circle")
    curves.loc[curves["controller"] == "b", "rms_error_evaluated"] *= 3.0
    other = curves.assign(
        sensing="pixel",
        feature_unit="px",
        rms_error_evaluated=1000.0 * curves["rms_error_evaluated"],
    )
    result = judge(pd.concat([curves.assign(sensing="position"), other])).result
    assert "4.00 mm ahead of `b`" in result
    assert "4.00 px ahead of `b`" in result


def test_where_lost_runs_tell_is_told_apart_from_where_times_do_in_whatever_order():
    near, lost = runs_of(8, a=1.0, b=1.5), runs_of(8, a=1.0, b=np.nan).assign(mismatch="severe")
    for parts in ((near, lost), (lost, near)):
        clauses = judge(pd.concat(parts)).result.rstrip(".").split("; ")
        assert sorted(each.partition(" on kinematic, ")[2] for each in clauses) == [
            "moderate`: 0.50 s ahead of `b` in settling time", "severe`, losing fewer runs than `b`",
        ]  # fmt: skip


def test_runs_that_an_unfinished_batch_lacks_are_neither_lost_nor_settled():
    runs = runs_of(10, a=1.0, b=1.0, c=np.nan)
    part = runs[(runs["controller"] != "b") | (runs["seed"] < 4)]
    assert leaders(part)["First", "median"].tolist() == ["1.02 s [1.00, 1.03]"]
    assert (
        "`a` and `b` each settled in 100 % of runs; least often `c`, in 0 of 10"
        in judge(part).result
    )


def test_one_controller_has_a_median_in_one_place_only_and_keeps_its_name():
    runs = runs_of(8, h_inf=1.0)
    assert "after a median of 1.04 s" in judge(runs).result
    several = judge(pd.concat([runs, runs.assign(mismatch="severe")])).result
    assert several == "`h_inf` settled in 16 of 16 runs."  # pairs of them share a robot
