"""Challenges as files, their scores by hand, and the command `suite`."""

import math

import numpy as np
import pandas as pd
import pytest

from kit.command import servobench
from kit.own import write
from servobench.harness.analysis.decisions import Question
from servobench.harness.analysis.tables import as_plain
from servobench.harness.apps.studies.challenge import (
    GRADES,
    MEASURES,
    Challenge,
    Grade,
    challenge_names,
    choose_challenges,
    find_challenge,
)
from servobench.harness.apps.studies.suite import (
    METHODS,
    RANKING,
    RUNS,
    bounded,
    challenge_answers,
    draw_suite,
    judge,
    methods_rows,
    ranking_rows,
    shared_robots,
    suite_tables,
)
from servobench.harness.batch import results
from servobench.plant.contract.faults import ConfigurationError

WORLD = """
title = "A short move"
why = "Two seconds are enough for a small move."
task = "random"
measure = "settling"
reference = "calibrated"
plants = "kinematic"
"""


# They are in no ranking and no stored table.
LATER = {f"{world}_{task}" for world in ("zeros180", "unknown_arm") for task in ("tour", "again")}
STAMPED = {"jitter_stamped", "latency_swing_stamped"}
UNGRADED = LATER | STAMPED


@pytest.mark.parametrize("name", challenge_names())
def test_every_challenge_of_the_package_can_be_carried_out_and_says_why_it_is_there(name):
    challenge = find_challenge(name)
    assert challenge.why.endswith(".")
    assert challenge.plants == ("kinematic",)
    if name in UNGRADED:
        assert challenge.grade == Grade()
    else:
        assert challenge.grade.name in GRADES
        assert challenge.grade.date is not None
        assert len(challenge.grade.scores) > 4
    runs = challenge.cells((), ("ukf_mfac", "calibrated"), range(5), bounded=2)
    assert len({run.request.run_id for run in runs}) == len(runs) == 5 + 2 * 2


def test_a_challenge_fixes_its_settings_by_role_on_every_plant():
    own = find_challenge("hidden").cells((), ("rls",), [7])[0].request
    assert own.varied == (("plant.sensing.occlusion_duration", 1.5), ("run.lost_after", 20.0))
    assert dict(find_challenge("all_at_once").cells((), ("rls",), [7])[0].request.varied) == {
        "plant.sensing.noise_factor": 4.0, "plant.sensing.latency": 0.15, "task.lap_time": 6.0,
    }  # fmt: skip


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            WORLD + 'plant = "fmu"',
            "world.toml: challenge has no setting 'plant': did you mean 'plants'",
        ),
        (WORLD.replace("random", "circel"), "world.toml: .*'circel'.*did you mean 'circle'"),
        (WORLD.replace('why = "', '# "'), "world.toml: why is missing"),
        (WORLD.replace('reference = "calibrated"', ""), "world.toml: reference is missing"),
        (
            WORLD.replace('"calibrated"', '"rls"'),
            "reference rls does not know the true robot; wanted calibrated",
        ),
        (
            WORLD.replace("random", "circle"),
            "measure settling is for moves, and circle is a curve; wanted path",
        ),
        (
            WORLD.replace("random", "tour"),
            "measure settling is for moves, and tour is a sequence; wanted later",
        ),
        (
            WORLD.replace("settling", "later"),
            "measure later is for sequences, and random is a point_to_point; wanted settling",
        ),
        (
            WORLD.replace("settling", "time"),
            "measure must be one of settling, later, path, got 'time'",
        ),
        (WORLD + 'mismatch = "moderate+tol=3mm"', "world.toml: .*did you mean 'tool'"),
        (WORLD + "period = 0", "period must be above 0, got 0"),
        (
            WORLD + "settings.kinematic.lag = 0.1",
            "kinematic.lag must begin with one of run., plant., task.",
        ),
        (WORLD + "settings.task.lap_time = 3", "world.toml: random has no setting 'lap_time'"),
        (
            WORLD + 'grade = {name = "IV", date = 2026-11-23}',
            "name must be one of , I, II, III, got 'IV'",
        ),
        ("title = ", "is not valid TOML"),
    ],
)
def test_a_bad_file_is_one_line_that_names_it_and_the_fault(tmp_path, text, message):
    file = write(tmp_path, text, "world.toml")
    with pytest.raises(ConfigurationError, match=message) as raised:
        find_challenge(str(file))
    assert "\n" not in str(raised.value)


@pytest.mark.usefixtures("own_folder")
def test_files_that_a_challenge_names_are_found_from_its_folder(tmp_path):
    world = WORLD.replace("settling", "path")
    write(
        tmp_path,
        "from servobench.harness.run.tasks import LineTask\nclass Mine(LineTask):\n    'A line.'",
        "a/line.py",
    )
    write(tmp_path, "time_s,x_m,y_m,z_m\n0,0,0,1.3\n3,0.1,0,1.3\n", "a/way.csv")
    own = write(tmp_path, world.replace("random", "own=./line.py:Mine"), "a/own.toml")
    way = write(
        tmp_path,
        world.replace("random", "waypoints") + "settings.task.file = 'way.csv'",
        "a/way.toml",
    )
    found = choose_challenges([str(own), str(way)], [])
    assert [each.task for each in found] == ["own", "waypoints"]
    assert found[1].settings == {"task.file": str(tmp_path / "a" / "way.csv")}


def test_challenges_are_chosen_by_name_file_and_grade(tmp_path):
    file = write(tmp_path, WORLD + 'grade = {name = "II", date = 2026-11-23}', "severe.toml")
    assert [each.title for each in choose_challenges([str(file)], ["II", "III"])] == [
        "A short move"
    ]
    with pytest.raises(ConfigurationError, match="none of these challenges is of grade I: severe"):
        choose_challenges([str(file)], ["I"])
    with pytest.raises(ConfigurationError, match="two challenges are called severe"):
        choose_challenges(["severe", str(file)], [])
    with pytest.raises(ConfigurationError, match="unknown grade '3': wanted I, II, III"):
        choose_challenges(["severe"], ["3"])
    with pytest.raises(
        ConfigurationError, match="unknown challenge 'sever': did you mean 'severe'"
    ):
        find_challenge("sever")


def table_of(values, column, task_kind, band):
    """Return a table of runs, a row for each controller and seed; NaN is a run that crashed."""
    rows = [
        {"plant": "kinematic", "controller": name, "seed": seed, "task": "any", "task_kind": task_kind,
         "settling_band": band, "status": "controller_error" if math.isnan(value) else "completed",
         column: value if value >= 0.0 else math.nan}
        for name, own in values.items()
        for seed, value in enumerate(own)
    ]  # fmt: skip
    return pd.DataFrame(rows)


def challenge(measure, **changes):
    names = ("calibrated", "nmpc_calibrated")
    return Challenge(
        "world", "A world", "For a reason.", "any", measure=measure, reference=names, **changes
    )


def test_scores_of_moves_come_out_as_by_hand():
    never = -1.0
    values = {"mine": [0.5, 2.0, never, 0.02, math.nan], "calibrated": [0.6, 1.0, 1.0, 0.01, 1.0],
              "nmpc_calibrated": [1.0, 0.5, never, 0.03, 2.0]}  # fmt: skip
    judged = judge(
        challenge("settling"), table_of(values, "settling_time_s", "point_to_point", 0.005)
    )
    own = judged[judged["controller"] == "mine"]
    np.testing.assert_allclose(own["score"], [1.0, 0.25, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(own["reference"], [0.6, 0.5, 1.0, 0.05, 1.0])
    (row,) = [row for row in as_plain(methods_rows(judged)) if row["controller"] == "mine"]
    assert (row["lost"], row["good"]["value"], row["reference_lost"]) == (40.0, 60.0, 0.0)
    assert row["score"] == pytest.approx(0.45)
    assert row["median"]["value"] == 2.0


def test_scores_of_curves_are_in_millimetres_with_a_floor_and_need_a_reference():
    values = {
        "mine": [0.001, 0.006, 0.011, 0.004],
        "calibrated": [0.0005, 0.002, 0.02],
        "nmpc_calibrated": [0.003] * 3,
    }
    judged = judge(challenge("path"), table_of(values, "rms_error_evaluated", "curve", 0.005))
    own = judged[judged["controller"] == "mine"]
    np.testing.assert_allclose(own["score"], [1.0, 2.0 / 6.0, 0.0, math.nan])
    np.testing.assert_allclose(own["measured"], [1.0, 6.0, 11.0, 4.0])
    np.testing.assert_allclose(own["value"], [1.5, 6.0, math.nan, 4.0])
    assert MEASURES["path"].floor == 0.0015


def test_scores_of_sequences_are_of_later_moves_whether_or_not_the_first_one_settled():
    values = {"mine": [0.8, 2.0, -1.0, math.nan], "calibrated": [0.4, 3.0, 1.0, 1.0]}
    runs = table_of(values, "settling_time_later_s", "sequence", 0.005).assign(
        outcome="not_settled"
    )
    judged = judge(challenge("later"), runs)
    own = judged[judged["controller"] == "mine"]
    np.testing.assert_allclose(own["score"], [0.5, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(own["reference"], [0.4, 3.0, 1.0, 1.0])


@pytest.mark.parametrize("name", sorted(STAMPED))
def test_a_world_with_stamps_differs_from_that_without_by_them_alone(name):
    own = find_challenge(name)
    without = find_challenge(name.removesuffix("_stamped"))
    same = ("task", "mismatch", "measure", "reference", "plants", "period", "latency", "noise")
    for key in same:
        assert getattr(own, key) == getattr(without, key), key
    assert own.settings == {"plant.sensing.stamps": True}
    assert without.settings == {}


@pytest.mark.parametrize("name", sorted(LATER))
def test_a_world_of_later_moves_differs_from_single_ones_by_task_and_measure_alone(name):
    own = find_challenge(name)
    world, _, task = name.rpartition("_")
    single = find_challenge(world)
    assert (own.task, own.measure) == (task, "later")
    same = ("mismatch", "reference", "plants", "period", "latency", "noise", "settings")
    for key in same:
        assert getattr(own, key) == getattr(single, key), key


def test_the_challenges_without_a_grade_are_those_of_later_moves_and_of_stamps():
    graded = choose_challenges(challenge_names(), GRADES)
    assert set(challenge_names()) - {each.name for each in graded} == UNGRADED


def test_a_challenge_whose_references_fail_has_no_part_in_the_ranking():
    lost = {
        "mine": [1.0] * 20,
        "calibrated": [-1.0] * 2 + [1.0] * 18,
        "nmpc_calibrated": [-1.0] * 2 + [1.0] * 18,
    }
    judged = judge(
        challenge("settling"), table_of(lost, "settling_time_s", "point_to_point", 0.005)
    )
    assert {row["reference_lost"].value for row in methods_rows(judged)} == {10.0}
    assert bounded(judged).empty
    (title, _), *further = suite_tables(judged)
    assert title.startswith("world (no grade, as its references fail) on kinematic")
    assert not further
    # 5.04 %, which are printed as 5.0
    more = {"mine": [1.0] * 119, "calibrated": [-1.0] * 6 + [1.0] * 113}
    (title, _), *_ = suite_tables(
        judge(challenge("settling"), table_of(more, "settling_time_s", "point_to_point", 0.005))
    )
    assert title.startswith("world (no grade, as its references fail)")
    rescued = lost | {"nmpc_calibrated": [-1.0] + [1.0] * 19}  # one of the two holds on this robot
    judged = judge(
        challenge("settling"), table_of(rescued, "settling_time_s", "point_to_point", 0.005)
    )
    assert {row["controller"].value for row in ranking_rows(judged)} == set(lost)
    judged = judge(
        challenge("settling"),
        table_of({"calibrated": [1.0] * 4}, "settling_time_s", "point_to_point", 0.005),
    )
    *_, (title, _) = suite_tables(judged)
    assert title.endswith("halves of the robots differ by less than 0.001 in the score")


def test_pictures_of_two_mappings_of_one_name_are_four_files(tmp_path):
    judged = judge(
        challenge("settling"),
        table_of({"calibrated": [1.0] * 2}, "settling_time_s", "point_to_point", 0.005),
    )
    drawn = [draw_suite(judged.assign(plant=f"fmu:{folder}/arm.toml"), tmp_path) for folder in "ab"]
    assert len({*drawn[0], *drawn[1]}) == 4


def test_a_reference_of_some_challenges_only_has_no_rank():
    own = {"mine": [1.0] * 3, "calibrated": [1.0] * 3}
    tables = [
        table_of(values, "settling_time_s", "point_to_point", 0.005)
        for values in (own, own | {"more": [1.0] * 2})
    ]
    first, second = challenge("settling"), Challenge("other", reference=("calibrated", "more"))
    judged = pd.concat([judge(first, tables[0]), judge(second, tables[1])], ignore_index=True)
    assert [row["controller"].value for row in ranking_rows(judged)] == ["mine", "calibrated"]
    assert len(methods_rows(judged)) == 5


@pytest.mark.slow
def test_the_command_scores_methods_in_ones_own_world_and_goes_on_where_it_stopped(
    refusal_of, output_of, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "short.toml").write_text(WORLD + "settings.task.duration = 2.0", encoding="utf-8")
    words = ["suite", "--challenges", "short.toml", "--controllers", "constant,broyden", "--seeds", "3",
             "--out", "suite", "--workers", "1", "--reference-seeds", "2"]  # fmt: skip
    text = output_of(*words)
    assert "short (ungraded) on kinematic: A short move; reference" in text
    assert "ranking on kinematic over 1 of 1; halves of the robots differ by" in text
    runs = results.load_runs(tmp_path / "suite" / "short")
    assert runs["controller"].value_counts().to_dict() == {
        "constant": 3,
        "broyden": 3,
        "calibrated": 2,
    }
    first = {name: (tmp_path / "suite" / name).read_text() for name in (RUNS, METHODS, RANKING)}
    assert (tmp_path / "suite" / "suite_kinematic.png").is_file()
    assert servobench(monkeypatch, *words, "--resume") == 0
    assert {name: (tmp_path / "suite" / name).read_text() for name in first} == first
    assert "exists already" in refusal_of(*words)


def test_a_world_with_a_camera_of_ones_own_stands_beside_one_without(
    output_of, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    write(tmp_path, "width = 640\nheight = 480\nvertical_fov = 50\n", "eye.toml")
    short = WORLD + "settings.task.duration = 2.0\n"
    write(tmp_path, short, "plain.toml")
    write(tmp_path, 'camera = "eye.toml"\n' + short, "seen.toml")
    text = output_of(
        "suite", "--challenges", "plain.toml,seen.toml", "--controllers", "constant", "--seeds", "1",
        "--out", "suite", "--workers", "1",
    )  # fmt: skip
    assert "ranking on kinematic over 2 of 2" in text
    robots = {
        name: results.load_runs(tmp_path / "suite" / name)["robot"] for name in ("plain", "seen")
    }
    assert {name: set(each) for name, each in robots.items()} == {
        "plain": {"ur5"},
        "seen": {"ur5 with eye.toml"},
    }


def test_a_challenge_is_decided_by_its_measure_and_its_lost_runs():
    rng = np.random.default_rng(0)
    base = rng.uniform(0.6, 1.2, 64)
    never = np.where(np.arange(64) % 4 == 0, -1.0, base)
    values = {"mine": base, "slow": base + 0.3, "rash": never, "calibrated": base[:16]}
    runs = table_of(values, "settling_time_s", "point_to_point", 0.005)
    runs["run_id"] = runs["controller"] + runs["seed"].astype(str)
    question = Question.ask(["mine", "slow", "rash"], None, 1, range(64))
    found = challenge_answers(challenge("settling"), runs, question)
    assert [each.pair for each in found][:2] == [("mine", "slow"), ("mine", "rash")]
    assert [each.decision.verdict for each in found[:2]] == ["better", "better"]
    assert [each.decision.told_by_lost for each in found[:2]] == [False, True]
    assert found[0].margin == 0.05
    ended = runs[(runs["controller"] != "slow") | (runs["seed"] < 32)]
    shared = shared_robots(judge(challenge("settling"), ended), challenge("settling"))
    assert shared.groupby("controller").size().to_dict() == {
        "calibrated": 16, "mine": 32, "rash": 32, "slow": 32,
    }  # fmt: skip
