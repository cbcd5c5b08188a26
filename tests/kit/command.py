"""The command line as a user meets it, within the process of the test."""

from __future__ import annotations

import sys

import pytest

from servobench.harness.cli.main import main


def servobench(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run `servobench` with arguments and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["servobench", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return int(stop.value.code or 0)
