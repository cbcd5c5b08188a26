"""Completion in a real bash, also behind the colons and equals signs at which it splits words."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import sys
import time
from pathlib import Path

import pytest

from kit.command import PACKAGE
from servobench.harness.cli.main import join_words

BASH = shutil.which("bash")


def complete(line: str, folder: Path) -> str:
    """Type a line and the tab key in an interactive bash, and return what the line is then."""
    program = folder / "servobench"
    program.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m servobench "$@"\n')
    program.chmod(0o755)
    environment = {**os.environ, "PATH": f"{folder}:{os.environ['PATH']}", "PYTHONPATH": str(PACKAGE), "TERM": "dumb"}
    pid, terminal = pty.fork()
    if pid == 0:
        os.execve(BASH, [BASH, "--norc", "--noprofile", "-i"], {**environment, "PS1": "> "})
    shown = ""

    def wait_for(pattern: str) -> re.Match[str]:
        nonlocal shown
        deadline = time.monotonic() + 120
        while not (found := re.search(pattern, shown)):
            assert time.monotonic() < deadline, shown
            if select.select([terminal], [], [], 1.0)[0]:
                shown += os.read(terminal, 4096).decode()
        return found

    try:
        os.write(terminal, b'eval "$(servobench --show-completion bash)"; echo "rea""dy"\n')
        wait_for("ready\r\n")
        shown = ""
        os.write(terminal, f'{line}\t\x01echo "is: \x05"\n'.encode())  # control and A, E: to the begin and the end
        return wait_for("\nis: (.*)\r\n")[1]
    finally:
        os.close(terminal)
        os.waitpid(pid, 0)


@pytest.mark.skipif(BASH is None, reason="bash is not installed")
def test_bash_completes_a_name_behind_its_colon(tmp_path):
    line = "servobench compare --controllers constant,ukf_mfac:"
    assert complete(f"{line}pub", tmp_path) == f"{line}published "


@pytest.mark.parametrize(
    ("words", "joined", "before"),
    [
        (["servobench", "run", "ukf"], ["servobench", "run", "ukf"], ""),
        (["servobench", "run", "ukf_mfac", ":", "pub"], ["servobench", "run", "ukf_mfac:pub"], "ukf_mfac:"),
        (["servobench", "run", "ukf_mfac", ":"], ["servobench", "run", "ukf_mfac:"], "ukf_mfac:"),
        (["servobench", "run", "--plant", "=", "kin"], ["servobench", "run", "--plant=kin"], "--plant="),
        (["servobench", "run", "a", "=", "./b.py", ":", "M"], ["servobench", "run", "a=./b.py:M"], "a=./b.py:"),
        (["servobench", "run", "a", ":", "b", ""], ["servobench", "run", "a:b", ""], ""),
    ],
)
def test_words_are_joined_as_they_were_typed(words, joined, before):
    assert join_words([*words, "after"], len(words) - 1) == (joined, before)
