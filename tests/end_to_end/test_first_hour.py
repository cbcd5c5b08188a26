"""The site as a newcomer follows it: each page that shows commands, in a folder of its own.

What a page shows with a prompt is carried out and compared with what it prints. Of the pages of the first hour every
block is pasted, also those without a prompt, which have to end with exit code 0. `make nightly` carries all out as they
are written, in a shell; `make test` draws nothing and carries blocks of commands out in this process, with one robot.
"""

import os
import re
import shlex
import shutil
import sys
from pathlib import Path

import pandas as pd
import pytest

import generated_tables
from kit import console
from kit.command import PACKAGE, carried_out, servobench
from kit.documents import DOCS, ROOT, blocks, read
from kit.nightly import NIGHTLY
from kit.robots import calibration_text, odd_urdf
from servobench.harness.batch import results
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS

ORDER = re.findall(
    r"^(?:.*<)?(\w+)>?$", "".join(blocks(read("index.md"), "{toctree}")), re.MULTILINE
)
SESSIONS = [page.stem for page in DOCS if "```console\n" in page.read_text(encoding="utf-8")]
HOUR = ("five_minutes", "own_controller", "own_robot", "own_sensing", "fmu", "learning")
SITE = sorted({*SESSIONS, *HOUR}, key=ORDER.index)
LEFT_OUT = {  # words of a block -> why it is not carried out
    "--platforms all": "needs the compilers of the extra cross",
    "train_policy.py": "trains for minutes; test_examples.py trains in small",
    "tune --controllers": "tunes for half an hour; test_own_tuning.py tunes in small",
    "mine.toml --plants": "needs the FMU of a controller; test_fmu_controller.py closes loops with some",
}
if generated_tables.RELEASED:
    LEFT_OUT["-m venv"] = "every release is installed into a fresh environment, by make release"
LONG = {  # words of a block that only `make nightly` carries out -> processor time [s]
    "nominal_rate,nominal_broyden": 25,
    "--sensing all": 20,
    "fmu export --controller": 12,
    "random_arm:7": 11,
    "ur5_severe.fmu": 7,
    "stereo.fmu": 4,
}
# Words of a session with a prompt that only `make nightly` carries out -> processor time [s]
LONG_SESSIONS = {"--tasks circle --seeds 3 --no-report": 18}
SHIMS = {
    "servobench": 'exec "{python}" -m servobench "$@"',
    "python": 'exec "{python}" "$@"',
    # What servobench needs is there; a distribution of the reader's is installed as pip does, into a folder of its own.
    "pip": 'case "$2" in ./*) exec "{python}" -m pip install --quiet --no-index --no-deps --no-build-isolation '
    '--disable-pip-version-check --target "{site}" "$2";; esac',
}
SEEDS = re.compile(r"--seeds (\d+:)?\d+")


class Reader:
    """A reader with a folder, who has `servobench`, `python` and `pip`, and pastes what is to be pasted."""

    def __init__(self, folder: Path, tools: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        self.folder, self.monkeypatch = folder, monkeypatch
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
        left_out = LEFT_OUT if NIGHTLY else LEFT_OUT | LONG
        if any(words in block for words in left_out):
            return
        lines = block.replace("\\\n", " ").splitlines()
        if not NIGHTLY and all(line.startswith("servobench ") for line in lines):
            for line in lines:
                self.call(SEEDS.sub(lambda match: f"--seeds {one_robot(match[1])}", line))
            return
        command = ["bash", "-e", "-c", block] if kind == "shell" else [sys.executable, "-c", block]
        made = carried_out(*command, cwd=self.folder, env=self.environment, timeout=3600)
        assert made.returncode == 0, (
            f"{block}\nexit code {made.returncode}: {made.stdout}{made.stderr}"
        )

    def call(self, line: str) -> None:
        """Carry out a line in this process."""
        assert servobench(self.monkeypatch, *shlex.split(line, comments=True)[1:]) == 0, line


def one_robot(first: str | None) -> str:
    """Return the seed of one robot, the first one of a range if there is one, such as "100:"."""
    return f"{first}{int(first[:-1]) + 1}" if first else "1"


def lay_out(reader: Reader, text: str) -> None:
    """Make the files that a reader has of their own, where a page names them."""
    folder = reader.folder
    if "my_ur10e.yaml" in text:
        (folder / "my_ur10e.yaml").write_text(calibration_text(UNIVERSAL_ROBOTS["UR10e"], seed=1))
        (folder / "my_arm.urdf").write_text(re.sub(r"\bhand\b", "tool0", odd_urdf()))
    if "./excite.py" in text:
        shutil.copy(ROOT / "docs" / "examples" / "excite.py", folder)
    if "./nominal-rate" in text:
        shutil.copytree(ROOT / "docs" / "examples" / "nominal-rate", folder / "nominal-rate")
    if "shadow first" in text:
        reader.call("servobench run --plant kinematic --out first")
        pd.read_parquet(folder / "first" / "steps.parquet").to_csv(
            folder / "robot.csv", index=False
        )
    if "mine.fmu" in text:
        reader.call("servobench fmu export -o mine.fmu")


@pytest.fixture
def reader(monkeypatch, tmp_path):
    """A reader in an empty folder, who except at night has one processor and gets neither figures nor reports."""
    folder, tools = tmp_path / "folder", tmp_path / "tools"
    folder.mkdir()
    tools.mkdir()
    monkeypatch.chdir(folder)
    if not NIGHTLY:
        monkeypatch.setattr("servobench.harness.batch.blocks.available_processors", lambda: 1)
        monkeypatch.setattr("servobench.harness.apps.figures.figures.draw_figures", lambda _: [])
        monkeypatch.setattr(
            "servobench.harness.apps.report.page.write_report",
            lambda made, _: made.path / results.RUNS,
        )
    return Reader(folder, tools, monkeypatch)


@pytest.mark.skipif(os.name != "posix", reason="the lines are those of a POSIX shell")
@pytest.mark.parametrize("page", SITE)
def test_what_a_page_shows_is_what_comes_out(reader, monkeypatch, capsys, page):
    text = read(f"{page}.md")
    lay_out(reader, text)
    paste = reader.paste if page in HOUR else None
    left_out = () if NIGHTLY else LONG_SESSIONS
    count = console.carry_out(text, monkeypatch, capsys, reader.folder, paste, left_out)
    assert count > 0 or page in HOUR


def test_the_first_hour_begins_the_site_and_each_of_its_pages_leaves_its_own_folders():
    assert SITE[: len(HOUR)] == list(HOUR)
    texts = [read(f"{page}.md") for page in HOUR]
    made = [set(re.findall(r"--out (\w+)", text)) for text in texts]
    assert len(set.union(*made)) == sum(map(len, made))
    pasted = [
        what
        for text in texts
        for kind, what, _ in console.steps(text)
        if kind in ("shell", "python")
    ]
    assert [
        words for words in (*LEFT_OUT, *LONG) if not any(words in block for block in pasted)
    ] == []
    sessions = [
        " ".join(what)
        for text in texts
        for kind, what, _ in console.steps(text)
        if kind == "command"
    ]
    assert all(any(words in line for line in sessions) for words in LONG_SESSIONS)
