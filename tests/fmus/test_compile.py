"""The C compiler that is taken: CC may hold options."""

from __future__ import annotations

import shutil

import pytest

from servobench.fmus.compile import CompilerMissing, compile_library, this_platform

SOURCE = "#ifndef ANSWER\n#error no answer\n#endif\nint answer(void) { return ANSWER; }\n"


@pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
def test_cc_may_hold_options(tmp_path, monkeypatch):
    monkeypatch.setenv("CC", "cc -DANSWER='6 * 7'")
    (tmp_path / "answer.c").write_text(SOURCE)
    compile_library(tmp_path, ["answer.c"], this_platform(), tmp_path / "answer.so")
    assert (tmp_path / "answer.so").stat().st_size > 0


@pytest.mark.parametrize("command", ["no_such_compiler -m64", "'unfinished"])
def test_a_cc_that_is_not_there_is_named(command, tmp_path, monkeypatch):
    monkeypatch.setenv("CC", command)
    with pytest.raises(CompilerMissing, match="CC names .*which was not found"):
        compile_library(tmp_path, ["answer.c"], this_platform(), tmp_path / "answer.so")
