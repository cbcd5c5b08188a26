"""Lines about long commands, for pipes and files."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from servobench.harness.cli import progress
from servobench.harness.cli.progress import FIRST_LINE, ConsoleObserver, Lines, telling


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=100.0)
    monkeypatch.setattr(progress, "Lines", lambda: Lines(lambda: clock.now))
    return clock


def piped():
    return Console(file=io.StringIO(), force_terminal=False)


def test_short_work_is_silent_and_long_work_tells_the_time_left(capsys, clock):
    with telling(piped(), "reading") as tell:
        for percent in range(101):
            tell(percent / 100, "frames")
            clock.now += 0.01 * FIRST_LINE
        assert capsys.readouterr().err == ""
        clock.now = 100.0 + 2 * FIRST_LINE
        tell(0.25, "frames")
    assert capsys.readouterr().err == f"frames: 25 %, about {6 * FIRST_LINE:.0f} s left\n"


def test_a_long_night_is_few_lines(capsys, clock):
    lines = progress.Lines()
    for k in range(8 * 3600):
        clock.now += 1.0
        lines.tell(k / (8 * 3600), "runs")
    assert 50 < capsys.readouterr().err.count("\n") < 100


def test_a_batch_tells_its_runs_in_a_pipe_and_draws_a_bar_in_a_terminal(capsys, clock):
    for terminal, wanted in ((False, "60 of 100 runs, about 40 s left\n"), (True, "")):
        console = Console(file=io.StringIO(), force_terminal=terminal)
        observer = ConsoleObserver(console)
        observer.begin(100, 50)
        clock.now += 10.0
        observer.finished([{}] * 10)
        observer.close()
        assert capsys.readouterr().err == wanted


def test_a_note_is_neither_markup_nor_words_for_the_terminal():
    console = piped()
    ConsoleObserver(console).note("left by [/red] of a\x1b[2J")
    assert console.file.getvalue() == "left by [/red] of a\\u001b[2J\n"
