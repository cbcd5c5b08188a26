"""The scripts in docs/examples run as they stand and print what they promise."""

from __future__ import annotations

import re
import runpy

import pytest

from kit.documents import ROOT

EXAMPLES = {
    "own_controller": r"ResolvedRate +\d.*\n.*constant.*\n.*ukf_mfac",
    "fmu_in_fmpy": r"nominal: ball at \[.*\n.*off by 3°: ball at",
    "what_if": r" 2\.0 +0 +\d\.\d +\d\.\d\n(.*\n)* +10\.0 +90 +4\d\d\.\d",
    "sweep_in_pandas": r"completed +18\n(.*\n)*.*constant +ukf_mfac\n",
}


def test_every_example_is_listed_here():
    assert {path.stem for path in (ROOT / "docs" / "examples").glob("*.py")} == set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_an_example_runs_and_prints(name, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    runpy.run_path(str(ROOT / "docs" / "examples" / f"{name}.py"), run_name="__main__")
    printed = capsys.readouterr().out
    assert re.search(EXAMPLES[name], printed), printed
