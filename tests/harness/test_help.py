"""What `servobench` says about itself: help, version, and the refusal of calls that cannot be understood."""

import re
from typing import Annotated

import pytest
import typer.main
from typer.testing import CliRunner

from kit.command import python, servobench
from servobench.harness.cli.applications import PANELS, assemble
from servobench.harness.cli.main import command_line, in_known_number
from servobench.harness.cli.main import servobench as first_options
from servobench.harness.cli.options import ABSENT, Value, command, named_option

ROOT = command_line()
COMMANDS = [
    *(name for name in ROOT.commands if name != "fmu"),
    *(f"fmu {name}" for name in ROOT.commands["fmu"].commands),
]


@pytest.fixture(autouse=True)
def _a_terminal_of_80_columns(monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")


def test_commands_come_in_the_order_of_first_use_each_on_one_line_of_80_columns(output_of):
    text = output_of()
    listed = [
        line[2:13].strip()
        for line in text.partition("First steps")[2].splitlines()
        if line.startswith("│")
    ]
    assert listed == list(ROOT.commands)
    assert listed[:2] == ["run", "compare"]
    assert listed[-1] == "fmu"
    titles = re.findall(r"─ ([A-Z][a-z ]+) ─", text)
    assert titles == ["Options", *PANELS]


def test_a_group_lists_each_command_in_one_line(output_of):
    text = output_of("fmu", "--help").partition("Commands")[2]
    assert [line.split()[1] for line in text.splitlines() if line.startswith("│")] == [
        "export", "ssp", "validate", "info",
    ]  # fmt: skip


@pytest.mark.parametrize("name", ["", *COMMANDS])
def test_every_command_explains_itself_and_its_values_and_nothing_is_cut(output_of, name):
    text = output_of(*name.split(), "-h" if name == "run" else "--help")
    assert f"Usage: servobench {name}".strip() in text
    assert "\\" not in text
    assert not re.search(r"<(?!date-time)|…", text)
    assert re.search(r"^│ (   )?--help +-h +Show this message and exit\.", text, re.MULTILINE)


@pytest.mark.slow
def test_a_terminal_of_no_width_and_one_of_few_letters_print_all_words():
    said = python("-m", "servobench", "tasks", COLUMNS="0", PYTHONIOENCODING="ascii")
    assert (said.returncode, said.stderr) == (0, "")
    assert "circle" in said.stdout
    assert said.stdout.isascii()


def test_no_word_in_brackets_is_taken_for_markup(output_of, monkeypatch):
    monkeypatch.setenv("COLUMNS", "300")
    assert "a [section] for each" in output_of("run", "--help")
    written = typer.main.get_command(assemble("", first_options)).commands
    for name in PANELS["First steps"] + PANELS["Studies"]:
        text = output_of(name, "--help")
        for each in written[name].params:
            for words in re.findall(r"\[.*?\]", each.help or ""):
                assert words in text


def test_version_and_commit_are_told(output_of):
    assert re.fullmatch(
        r"servobench \d\S*( \(commit [0-9a-f]{12}(, with changes)?\))?\n", output_of("--version")
    )


def test_ctrl_c_is_a_line_and_exit_code_130(monkeypatch, capsys):
    def interrupt(folder):
        raise KeyboardInterrupt

    monkeypatch.setattr("servobench.harness.batch.results.ResultsFolder.check_finished", interrupt)
    assert servobench(monkeypatch, "collect", ".") == 130
    assert capsys.readouterr().err == "servobench: interrupted\n"


COLOUR = Value("COLOUR", lambda incomplete: [incomplete + "ed"], lambda text: 2 * text)


def paint(
    *,
    shade: Annotated[
        str, named_option("--colour", COLOUR, "Shade of it.", {"wash": "no paint"})
    ] = "blue",
):
    typer.echo(shade)


def test_one_row_declares_name_help_completion_check_and_absence_of_an_option():
    one = typer.Typer()
    one.command()(command(paint))
    run = CliRunner().invoke
    assert run(one, ["--colour", "red"]).output == "redred\n"
    assert run(one, []).output == "blueblue\n"
    assert re.search(r"--colour +COLOUR +Shade of it\.", run(one, ["--help"]).output)
    (declared,) = (each for each in typer.main.get_command(one).params if each.name == "shade")
    assert [each.value for each in declared.shell_complete(None, "r")] == ["red"]
    assert ABSENT["wash", "--colour"] == "no paint"


@pytest.mark.parametrize(
    ("words", "read"),
    [
        (["robustness", "--plants", "kinematic", "--axis=links"],
         ["robustness", "--plant", "kinematic", "--axes=links"]),
        (["run", "--controllers", "constant"], ["run", "--controller", "constant"]),
        (["compare", "--seed", "7", "--controller", "constant"],
         ["compare", "--seeds", "7,", "--controllers", "constant"]),
        (["sweep", "--seed=7", "--mismatches", "none"], ["sweep", "--seeds=7,", "--mismatch", "none"]),
        (["tune", "--robot", "ur5"], ["tune", "--robot", "ur5"]),
        (["fmu", "export", "--robots", "ur5"], ["fmu", "export", "--robot", "ur5"]),
    ],
)  # fmt: skip
def test_options_are_taken_in_singular_and_plural(words, read):
    assert in_known_number(command_line(), words) == read
