"""Lines about long commands, for pipes and files."""

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from servobench.harness.cli import progress
from servobench.harness.cli.progress import FIRST_LINE, ConsoleObserver, Lines, show_time, telling


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


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (40.0, "40 s"),
        (119.0, "119 s"),
        (600.0, "10 minutes"),
        (9000.0, "2 hours"),
        (699377.0, "8 days"),
    ],
)
def test_a_time_is_told_in_its_largest_unit(seconds, words):
    assert show_time(seconds) == words


def test_many_runs_are_counted_before_they_begin_and_their_time_is_told_once(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(progress.time, "monotonic", lambda: now[0])
    console = piped()
    observer = ConsoleObserver(console)
    observer.begin(900_000, 0)
    assert console.file.getvalue() == "900,000 runs begin; Ctrl-C ends them, and --resume goes on\n"
    for _ in range(20):
        now[0] += 1.0
        observer.finished([{}])
    assert console.file.getvalue().splitlines()[1:] == ["899,995 runs are left, about 10 days"]
    observer.close()
