"""The site as a newcomer follows it, page by page in one folder.

What a page shows with a prompt is carried out and compared with what it prints. Of the pages of the first hour every
block is pasted, also those without a prompt, which have to end with exit code 0; those that take minutes only in
`make nightly`.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pandas as pd
import pytest

import generated_tables
from kit import console
from kit.command import PACKAGE
from kit.documents import DOCS, ROOT, blocks, read
from kit.nightly import NIGHTLY
from kit.robots import calibration_text, odd_urdf
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS

ORDER = re.findall(r"^(?:.*<)?(\w+)>?$", "".join(blocks(read("index.md"), "{toctree}")), re.MULTILINE)
SESSIONS = [page.stem for page in DOCS if "```console\n" in page.read_text(encoding="utf-8")]
HOUR = ("five_minutes", "own_controller", "own_robot", "own_sensing", "fmu", "learning")
SITE = sorted({*SESSIONS, *HOUR}, key=ORDER.index)
LEFT_OUT = {  # words of a block -> why it is not carried out
    "--platforms all": "needs the compilers of the extra cross",
    "train_policy.py": "trains for two minutes with a library that servobench does not need",
    "mine.toml --plants": "needs the FMU of a controller; test_fmu_controller.py closes loops with some",
}
if generated_tables.RELEASED:
    LEFT_OUT["-m venv"] = "every release is installed into a fresh environment, by make release"
LONG = {  # words of a block that only `make nightly` carries out -> processor time [s]
    "servobench record --robot panda": 90,
    "nominal_rate,nominal_broyden": 25,
}
SHIMS = {
    "servobench": 'exec "{python}" -m servobench "$@"',
    "python": 'exec "{python}" "$@"',
    # What servobench needs is there; a distribution of the reader's is installed as pip does, into a folder of its own.
    "pip": 'case "$2" in ./*) exec "{python}" -m pip install --quiet --no-index --no-deps --no-build-isolation '
    '--disable-pip-version-check --target "{site}" "$2";; esac',
}


class Shell:
    """A shell in a folder that has `servobench`, `python` and `pip`."""

    def __init__(self, folder: Path, tools: Path) -> None:
        self.folder, self.seen = folder, []
        site = tools / "site"
        for name, line in SHIMS.items():
            shim = tools / name
            shim.write_text(f"#!/bin/sh\n{line.format(python=sys.executable, site=site)}\n")
            shim.chmod(0o755)
        self.environment = os.environ | {
            "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": f"{PACKAGE}{os.pathsep}{site}",
        }

    def paste(self, kind: str, block: str) -> None:
        """Carry out a block of shell or Python, unless it is one of those that are left out."""
        self.seen.append(block)
        left_out = LEFT_OUT if NIGHTLY else LEFT_OUT | LONG
        if any(words in block for words in left_out):
            return
        line = ["bash", "-e", "-c", block] if kind == "shell" else [sys.executable, "-c", block]
        made = subprocess.run(
            line, cwd=self.folder, env=self.environment, capture_output=True, text=True, check=False, timeout=3600
        )
        assert made.returncode == 0, f"{block}\nexit code {made.returncode}: {made.stdout}{made.stderr}"


def lay_out(shell):
    """Make the files that a reader has of their own."""
    (shell.folder / "my_ur10e.yaml").write_text(calibration_text(UNIVERSAL_ROBOTS["UR10e"], seed=1))
    (shell.folder / "my_arm.urdf").write_text(re.sub(r"\bhand\b", "tool0", odd_urdf()))
    shutil.copytree(ROOT / "docs" / "examples" / "nominal-rate", shell.folder / "nominal-rate")
    shell.paste("shell", "servobench fmu export -o mine.fmu\nservobench run --plant kinematic --out logged")
    pd.read_parquet(shell.folder / "logged" / "steps.parquet").to_csv(shell.folder / "robot.csv", index=False)


def processor_time():
    """Return the time [s] of the processor that this process and those that it has started have taken."""
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


@pytest.mark.skipif(os.name != "posix", reason="the lines are those of a POSIX shell")
def test_what_the_pages_show_is_what_comes_out_one_page_after_the_other_in_one_folder(
    monkeypatch, capsys, tmp_path, record_testsuite_property
):
    assert SITE[: len(HOUR)] == list(HOUR)
    folder, tools = tmp_path / "folder", tmp_path / "tools"
    folder.mkdir()
    tools.mkdir()
    shell = Shell(folder, tools)
    lay_out(shell)
    for page in SITE:
        begin = processor_time()
        count = console.carry_out(
            read(f"{page}.md"), monkeypatch, capsys, folder, shell.paste if page in HOUR else None
        )
        assert count > 0 or page in HOUR
        record_testsuite_property(f"processor time of {page}, s", round(processor_time() - begin, 1))
    told = {*LEFT_OUT, *LONG}
    assert {words for block in shell.seen for words in told if words in block} == told
