"""The code of a foreign FMU runs in no process but one of its own, whatever command reads the FMU."""

import shutil
import subprocess
import zipfile
from pathlib import Path

import pytest

from kit import foreign_fmu
from kit.command import servobench
from kit.foreign_fmu import build_crane, describe
from kit.own import write
from servobench.fmus.compiler import this_platform
from servobench.fmus.reference import INPUT_FILE, OUTPUT_FILE
from servobench.harness.batch import results
from servobench.harness.batch.blocks import Job
from servobench.harness.batch.plan import Cell
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

ABORTS = "#include <stdlib.h>\n__attribute__((constructor)) static void load(void) { abort(); }\n"
RUN = (
    "--controllers", "broyden", "--tasks", "target", "--mismatch", "none", "--seeds", "2", "--set",
    "target.target=[0.2,0.7]", "--set", "target.duration=0.5", "--set", "broyden.initial.source=probe",
)  # fmt: skip


@pytest.fixture
def mapping(tmp_path) -> Path:
    """The mapping of an FMU with a reference run whose library ends every process that loads it."""
    (tmp_path / "aborts.c").write_text(ABORTS)
    library = tmp_path / "aborts.so"
    compiler = shutil.which("cc") or "gcc"
    subprocess.run(
        [compiler, "-shared", "-fPIC", str(tmp_path / "aborts.c"), "-o", str(library)], check=True
    )
    with zipfile.ZipFile(tmp_path / "crane.fmu", "w") as archive:
        archive.writestr("modelDescription.xml", describe(2))
        archive.writestr(
            f"binaries/{this_platform().folder(2)}/crane{this_platform().suffix}",
            library.read_bytes(),
        )
        archive.writestr(INPUT_FILE, "time,push.slew,push.luff\n0,0,0\n0.05,0,0\n")
        archive.writestr(OUTPUT_FILE, "time,wheel.slew,wheel.luff\n0,0.5,0.4\n0.05,0.5,0.4\n")
    return write(tmp_path, foreign_fmu.mapping(2), "crane.toml")


def test_an_fmu_that_ends_its_process_ends_no_command(output_of, mapping, monkeypatch):
    file = str(mapping.with_name("crane.fmu"))
    assert "wheel.slew" in output_of("fmu", "info", file)
    printed = output_of("fmu", "validate", file, code=1)
    assert (
        "the reference run ended: the run killed the process that carried it out: SIGABRT"
        in printed
    )
    out = mapping.with_name("out")
    plants = ("--plants", f"fmu:{mapping}", "--workers", "1", "--out", str(out))
    assert servobench(monkeypatch, "sweep", *plants, *RUN) == 0
    runs = results.load_runs(out)
    assert runs["status"].tolist() == ["crashed"] * 2
    assert runs["reason"].str.contains("SIGABRT").all()


def test_an_fmu_that_the_user_trusts_shares_a_process(tmp_path, monkeypatch):
    build_crane(tmp_path / "crane.fmu", 2)
    path = write(tmp_path, foreign_fmu.mapping(2), "crane.toml")
    plant = f"fmu:{path}"
    for trusted in (False, True):
        settings = Settings({plant: {"isolate": not trusted}})
        run = resolve(RunRequest(plant, "broyden", "target", "none", 0), settings)
        assert bool(Job(0, Cell(run.request), run).owner) != trusted
    monkeypatch.setattr("servobench.harness.batch.blocks.Pool", None)  # no process can be started
    arguments = (
        "--plants",
        plant,
        "--workers",
        "1",
        "--out",
        str(tmp_path / "out"),
        "--set",
        f"{plant}.isolate=false",
    )
    assert servobench(monkeypatch, "sweep", *arguments, *RUN) == 0
    assert set(results.load_runs(tmp_path / "out")["status"]) == {"completed"}
