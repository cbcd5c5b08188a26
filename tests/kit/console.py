"""Carries out the console sessions that pages show, and compares what they print with what the page says."""

import re
import shlex
import textwrap
from pathlib import Path

from kit.command import servobench
from kit.documents import FENCED

# Fenced, or indented
BLOCK = re.compile(rf"{FENCED.pattern}|(?<=\n\n)((?: {{4}}[^\n]*\n)+)", FENCED.flags)
# An indented block that goes into a shell
PASTED = re.compile(r" {4}(servobench|pip|python3?|for) ")
SAVED = re.compile(r"`([\w/-]+\.\w+)`:\s*$")  # the line before a block that is a file
ELLIPSIS = "..."
PROGRESS = re.compile(r"^(running|training)\b.*[━╸]|^report: ")  # times and sizes differ
VARYING = re.compile(
    r" \* some steps took longer than the period; simulated time waits|\d+ (?=figures)"
)  # 1: when busy
SLOW = re.compile(r"^note +time .*longer than the period.*$")  # of a check, when busy
# The last column of a table of runs: microseconds of wall clock
CLOCK = re.compile(r"(?<=\S) +\d+\*? *$")


def steps(text):
    """Yield what a page asks for in order.

    ("file", name, content), ("command", words, lines that it prints), or what is pasted elsewhere and prints what it
    likes: ("shell", lines, "") and ("python", code, "").
    """
    end = 0
    for match in BLOCK.finditer(text):
        before, end = text[end : match.start()].rstrip(), match.end()
        if match[3]:
            if PASTED.match(match[3]):
                yield "shell", textwrap.dedent(match[3]), ""
        elif match[1] == "console":
            for session in re.split(r"^\$ ", match[2], flags=re.MULTILINE)[1:]:
                command, _, printed = session.partition("\n")
                while command.endswith("\\"):
                    further, _, printed = printed.partition("\n")
                    command = command[:-1] + further.strip()
                yield "command", shlex.split(command), printed
        elif saved := SAVED.search(before):
            yield "file", saved[1], match[2]
        elif match[1] == "python":
            yield "python", match[2], ""


def plain(printed):
    """Return rows of tables and paragraphs of an output, without what differs from run to run."""
    found, text = [], []
    for line in [*printed.splitlines(), ELLIPSIS]:
        if PROGRESS.search(line) or not line.strip():
            continue
        if line.startswith(" ") or line == ELLIPSIS:
            found += [VARYING.sub("", " ".join(text))] if text else []
            found.append(" ".join(CLOCK.sub("", line).split()))
            text = []
        else:
            text += SLOW.sub("ok time", line).split()
    return found[:-1]


def carry_out(text, monkeypatch, capsys, folder, paste=None, left_out=()):
    """Do what a page says in a folder, and return how many commands it had.

    Every output is that of the page, with `...` for lines that are left out. Without `paste(kind, block)` only sessions
    with a prompt are carried out. A command with some words that are `left_out` is not.
    """
    monkeypatch.chdir(folder)
    count = 0
    for kind, what, content in steps(text):
        if kind == "file":
            Path(what).parent.mkdir(parents=True, exist_ok=True)
            Path(what).write_text(content, encoding="utf-8")
            continue
        if kind != "command":
            if paste is not None:
                paste(kind, what)
            continue
        assert what[0] == "servobench", what
        line = " ".join(what)
        if any(words in line for words in left_out):
            continue
        capsys.readouterr()
        code = servobench(monkeypatch, *what[1:])
        captured = capsys.readouterr()
        assert code == 0, f"{what}: exit code {code}: {captured.out}{captured.err}"
        compare(" ".join(what), plain(content), plain(captured.out))
        count += 1
    return count


def compare(command, told, printed):
    """Check the lines of a page against those that a command printed."""
    where = 0
    for line in told:
        if line == ELLIPSIS:
            where = None
            continue
        if where is None:
            assert line in printed, f"{command} does not print {line!r}, but:\n" + "\n".join(
                printed
            )
            where = printed.index(line)
        assert where < len(printed), f"{command} ends before {line!r}"
        assert printed[where] == line, (
            f"{command} prints {printed[where]!r}, the page says {line!r}"
        )
        where += 1
    if told and told[-1] != ELLIPSIS:
        assert where == len(printed), f"{command} also prints {printed[where:]}"
