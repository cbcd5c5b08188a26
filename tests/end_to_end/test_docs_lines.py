"""Every line of `servobench` that a page shows indented: it is read, and what it asks for is there.

What pages show with a prompt is carried out whole, by `test_docs.py`.
"""

import re
import shlex
from contextlib import nullcontext, suppress

import pytest

from kit.command import servobench
from kit.documents import FENCED, PAGES, ROOT
from kit.own import CONFIGURED, write
from servobench.harness.batch import campaign
from servobench.harness.cli.main import command_line
from servobench.harness.config.registry import default_plant
from servobench.plant.contract.faults import ConfigurationError

SHOWN = re.compile(r"^ {4,6}(?:\$ )?servobench (.*)$", re.MULTILINE)
REMARK = re.compile(r"\s+#\s.*$|\s{2,}\S.*$")
CONTINUED = re.compile(r"\s*\\\n\s+")
# Carried out up to the first worker
BATCHES = ("run", "compare", "sweep", "robustness", "suite")
QUICK = ("plants", "controllers", "tasks", "sensing", "init", "new", "check")  # carried out whole
ONLY_READ = {
    "fmu": "compiles a model, which test_robot_commands.py does",
    "record": "renders a film, which test_record.py does",
    "play": "serves until it is ended; tests/apps/play opens its page",
    "serve": "serves until it is ended; tests/harness/test_serve.py talks to it",
    "train": "trains networks, which the tests of controllers do",
    "tune": "takes hours; test_tune_command.py makes a few trials",
    "analyse": "logs runs of each method, which test_analyse.py does",
    "report": "needs the folder of a run, which test_report.py makes",
    "figures": "needs the folder of a run, which test_pictures.py makes",
    "statistics": "needs the folder of a run; docs/five_minutes.md carries it out",
    "export": "needs the folder of a batch; tests/harness/test_exports.py exports one",
    "identify": "needs a log; tests/harness/test_identification.py identifies some",
    "shadow": "needs a logged run; tests/harness/test_shadow.py shows some",
    "verify": "needs the folder of a batch; tests/harness/test_integrity.py damages some",
    "submit": "takes minutes; tests/apps/board submits on few robots",
    "leaderboard": "needs submissions, which tests/apps/board makes",
    "selftest": "needs the arithmetic of the reference; tests/apps/board compares it",
    "collect": "needs a batch that was killed; the tests of batches kill one",
}
# Files of the reader
OWN = (
    "mine.py",
    "my_ur10e.yaml",
    "my_world.toml",
    "my_arm.urdf",
    "mine.toml",
    "twin.toml",
    "crane.toml",
    "planar",
    "nominal_rate",
    "learned",
    "look_then_move",
)


def shown_lines():
    """Yield page and words of each line, without remarks; `a | b` are two lines."""
    for page in PAGES:
        text = CONTINUED.sub(" ", FENCED.sub("", page.read_text(encoding="utf-8")))
        for match in SHOWN.finditer(text):
            for line in REMARK.sub("", match[1]).split(" | "):
                if "…" not in line:
                    yield pytest.param(shlex.split(line), id=f"{page.relative_to(ROOT)}: {line}")


LINES = list(shown_lines())


class Asked(Exception):
    """Everything was checked, and the first worker is asked for."""


def test_the_pages_show_every_command():
    commands = {param.values[0][0] for param in LINES}
    assert commands == {*BATCHES, *QUICK, *ONLY_READ}


@pytest.mark.parametrize("words", LINES)
def test_every_line_is_one_that_the_command_line_reads(words):
    own = any(name in word for word in words for name in OWN)
    command = command_line()
    context = command.make_context("servobench", list(words))
    while hasattr(command, "resolve_command"):
        name, command, rest = command.resolve_command(
            context, context._protected_args + context.args
        )
        if "--help" not in rest:
            with (
                suppress(ConfigurationError) if own else nullcontext()
            ):  # of a file that is the reader's
                context = command.make_context(name, rest, parent=context)
    options = {
        option for each in command.params for option in (*each.opts, *each.secondary_opts)
    } | {"--help"}
    assert {word for word in words if word.startswith("--")} <= options


@pytest.mark.parametrize(
    "words",
    [
        line
        for line in LINES
        if line.values[0][0] in BATCHES and not any(own in line.id for own in OWN)
    ],
)
def test_every_batch_that_a_page_shows_can_begin(monkeypatch, tmp_path, words):
    def stop(*_, **__):
        raise Asked

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(campaign, "build_once", lambda *_: None)
    monkeypatch.setattr(campaign, "open_workers", stop)
    if "--help" in words:
        assert servobench(monkeypatch, *words) == 0
        return
    if "--view" in words and default_plant()[0] != "bullet":
        pytest.skip("--view needs PyBullet, which is not installed")
    with pytest.raises(Asked):
        servobench(monkeypatch, *words)


@pytest.mark.parametrize(
    "words",
    [
        line
        for line in LINES
        if line.values[0][0] in QUICK and not any(own in line.id for own in OWN)
    ],
)
def test_every_quick_line_does_what_it_says(output_of, monkeypatch, tmp_path, words):
    monkeypatch.chdir(tmp_path)
    if words[0] == "check":
        write(tmp_path, CONFIGURED, "my_law.py")
    assert output_of(*words).strip()
