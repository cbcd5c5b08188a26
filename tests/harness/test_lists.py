"""What there is, listed for readers and for programs, and completed by the shell, also behind colons."""

import json
import math
from pathlib import Path

import numpy as np
import pytest

from kit.command import servobench
from servobench.harness.batch.results import load_runs
from servobench.harness.cli.main import command_line, join_words
from servobench.harness.cli.selection import accepted, split_names
from servobench.harness.config.description import plain
from servobench.harness.config.registry import controller_names
from servobench.harness.config.settings import flatten
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.kinematic import ENTRY


@pytest.fixture(autouse=True)
def _a_terminal_of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


@pytest.mark.parametrize("kind", ["plants", "controllers", "tasks"])
def test_lists_fit_into_80_columns_and_no_name_is_broken(output_of, kind):
    text = output_of(kind)
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    listed = [
        line.split()[0] for line in text.split("\n\n")[0].splitlines() if not line.startswith(" ")
    ]
    assert listed == [each["name"] for each in json.loads(output_of(kind, "--json"))]


def test_all_names_and_summaries_are_there_as_json(output_of):
    found = json.loads(output_of("controllers", "--json"))
    assert [each["name"] for each in found] == controller_names()
    listed = json.loads(output_of("tasks", "--json"))
    assert listed == [{"name": name, "summary": entry.summary} for name, entry in TASKS.items()]


def test_settings_are_explained_to_readers_and_programs(output_of):
    found = json.loads(output_of("plants", "kinematic", "--json"))
    wanted = json.loads(
        json.dumps({f"kinematic.{key}": value for key, value in flatten(ENTRY.config()).items()})
    )
    assert {each["setting"]: each["default"] for each in found} == wanted
    lag = next(each for each in found if each["setting"] == "kinematic.lag")
    assert (lag["unit"], lag["allowed"]) == ("s", "≥ 0")
    text = output_of("plants", "kinematic")
    assert (
        "kinematic.lag = 0.05\n    [s] τ, time constant of the joints' velocity loops; 0 means none (≥ 0)"
        in text
    )


def test_values_that_json_has_no_word_for_are_text():
    found = plain((math.inf, -math.inf, Path("a.csv"), None, np.array([1.0, 2.0]), True, 3))
    assert found == ["inf", "-inf", "a.csv", None, [1.0, 2.0], True, 3]


def completed(*words):
    command, incomplete = command_line(), words[-1]
    for word in words[:-2] if words[-2].startswith("-") else words[:-1]:
        command = command.commands[word]
    named = words[-2] if words[-2].startswith("-") else None
    options = (
        each
        for each in command.params
        if named in each.opts or (not named and each.param_type_name == "argument")
    )
    context = command.make_context("x", [], resilient_parsing=True)
    return [item.value for item in next(options).shell_complete(context, incomplete)]


@pytest.mark.parametrize(
    ("words", "wanted"),
    [
        (("run", "ukf_m"), ["ukf_mfac", "ukf_mfac:published", "ukf_mpc", "ukf_mpc:published"]),
        (("run", "--controller", "mfac+br"), ["mfac+broyden"]),
        (("run", "--estimator", "ka"), ["kalman"]),
        (("run", "--plant", ""), ["kinematic", "bullet", "mujoco", "fmu"]),
        (("run", "--task", "exp"), ["exp1", "exp2", "exp3", "exp4"]),
        (("run", "--robot", "ur5"), ["ur5", "ur5e"]),
        (("run", "--mismatch", "mod"), ["moderate"]),
        (("run", "--mismatch", "moderate+camera_m"), ["moderate+camera_move="]),
        (("compare", "--controllers", "rls,ukf_mp"), ["rls,ukf_mpc", "rls,ukf_mpc:published"]),
        (("compare", "--tasks", "al"), ["all"]),
        (("sweep", "--plants", "kinematic,b"), ["kinematic,bullet"]),
        (("plants", "k"), ["kinematic"]),
        (("run", "--controller", "calib"), ["calibrating_mfac", "calibrated"]),
        (("init", "--tasks", "exp2,ci"), ["exp2,circle"]),
    ],
)
def test_the_shell_completes_names_also_within_lists(words, wanted):
    assert completed(*words) == wanted


@pytest.mark.parametrize(
    ("words", "joined", "before"),
    [
        (["servobench", "run", "ukf"], ["servobench", "run", "ukf"], ""),
        (
            ["servobench", "run", "ukf_mfac", ":", "pub"],
            ["servobench", "run", "ukf_mfac:pub"],
            "ukf_mfac:",
        ),
        (["servobench", "run", "ukf_mfac", ":"], ["servobench", "run", "ukf_mfac:"], "ukf_mfac:"),
        (
            ["servobench", "run", "--plant", "=", "kin"],
            ["servobench", "run", "--plant=kin"],
            "--plant=",
        ),
        (
            ["servobench", "run", "a", "=", "./b.py", ":", "M"],
            ["servobench", "run", "a=./b.py:M"],
            "a=./b.py:",
        ),
        (["servobench", "run", "a", ":", "b", ""], ["servobench", "run", "a:b", ""], ""),
    ],
)
def test_words_that_bash_splits_at_colons_and_equals_signs_are_joined_as_typed(
    words, joined, before
):
    assert join_words([*words, "after"], len(words) - 1) == (joined, before)


def test_a_word_of_a_list_is_a_name_if_it_is_known_chosen_or_accepted():
    assert split_names("kind", "b, a", ("a", "b")) == ("b", "a")
    assert split_names("kind", "x,all", ("a", "b"), str.upper, lambda: ["B"]) == ("X", "B")
    assert split_names("kind", "3", (), accepted(int)) == ("3",)
    with pytest.raises(ValueError, match="invalid literal"):
        split_names("kind", "three", (), accepted(int))
    with pytest.raises(ConfigurationError, match="^--kind names a twice$"):
        split_names("kind", "a,all", ("a", "b"))
    with pytest.raises(ConfigurationError, match="^--kind: unknown 'c': "):
        split_names("kind", "c", ("a", "b"))
    with pytest.raises(ConfigurationError, match="^--kind is empty; valid: a, b$"):
        split_names("kind", "", ("a", "b"))


def test_a_run_takes_its_controller_first(no_figures, monkeypatch, tmp_path):
    short = ("--plant", "kinematic", "--set", "exp2.duration=0.5", "--out", str(tmp_path / "out"))
    assert servobench(monkeypatch, "run", "constant", *short) == 0
    assert load_runs(tmp_path / "out")["run_id"].tolist() == ["kinematic-constant-exp2-moderate-0"]


def test_a_task_is_shown_for_an_arm(monkeypatch, capsys):
    def settings(*arguments):
        assert servobench(monkeypatch, "tasks", "circle", "--json", *arguments) == 0
        return {each["setting"]: each["default"] for each in json.loads(capsys.readouterr().out)}

    usual, other = settings(), settings("--robot", "ur10e")
    assert usual == settings("--robot", "ur5")
    assert other["circle.radius"] > 1.3 * usual["circle.radius"]
    assert other["circle.start"] != usual["circle.start"]
