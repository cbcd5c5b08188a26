"""Bad FMUs as a user meets them: one line, exit code 2 or a named status, and nothing left behind."""

import tempfile
import zipfile
from pathlib import Path

import pytest

from kit.command import servobench
from kit.foreign_fmu import build_crane, describe_with, mapping

FMI1 = describe_with(
    2, 'fmiVersion="2.0"', 'fmiVersion="1.0" modelIdentifier="crane" numberOfContinuousStates="0"'
)
TYPES = '<TypeDefinitions><SimpleType name="Rate"><Real unit="deg/s"/></SimpleType></TypeDefinitions><ModelVariables>'
IN_DEGREES = describe_with(2, "<ModelVariables>", TYPES).replace(
    '<Real start="0.0"/>', '<Real declaredType="Rate"/>'
)
SPEED = '<UnitDefinitions><Unit name="speed"><BaseUnit s="-1" rad="1" factor="{}"/></Unit></UnitDefinitions><TypeD'
SCALED = IN_DEGREES.replace('"deg/s"', '"speed"').replace("<TypeD", SPEED)
DIFFERENCE = SCALED.format('0.0174533" offset="3').replace(
    '"speed"/></S', '"speed" relativeQuantity="true"/></S'
)
METRES = SPEED.replace('s="-1" rad="1" factor="{}"', 'm="1"').replace("<TypeD", "<ModelV")
IN_METRES = describe_with(2, "<ModelV", METRES).replace("<Real/>", '<Real unit="speed"/>')
SCHEDULED_ONLY = describe_with(3, "<CoSimulation", "<ScheduledExecution")


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """A folder for temporary files in which nothing may remain."""
    folder = tmp_path / "temporary"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


def run(
    monkeypatch, tmp_path: Path, version: int, *options: str, more: str = ""
) -> tuple[int, Path]:
    (tmp_path / "crane.toml").write_text(mapping(version) + more)
    out = tmp_path / "out"
    task = ["--task", "target", "--set", "target.target=[0.2,0.7]", "--set", "target.duration=1"]
    start = [
        "--controller",
        "broyden",
        "--set",
        "broyden.initial.source=probe",
        "--mismatch",
        "none",
    ]
    arguments = [
        "run",
        "--plant",
        f"fmu:{tmp_path / 'crane.toml'}",
        *start,
        *task,
        "--out",
        str(out),
        *options,
    ]
    return servobench(monkeypatch, *arguments), out


def write(path: Path, entries: dict[str, str]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in entries.items():
            archive.writestr(name, content)


# What is wrong before anything is loaded; all three commands say so.
ARCHIVES = {
    "no such file": (lambda path: None, "crane.fmu does not exist"),
    "a folder": (lambda path: path.mkdir(), " is a directory"),
    "not a zip": (lambda path: path.write_text("hello"), "crane.fmu is not a zip archive"),
    "climbs": (lambda path: write(path, {"modelDescription.xml": "<x/>", "../../evil.txt": "evil"}),
        "holds '../../evil.txt', which would climb out"),
    "no description": (lambda path: write(path, {"readme": "hello"}), "holds no modelDescription.xml"),
    "broken XML": (lambda path: build_crane(path, 2, description="<fmiModelDescription"), "a broken modelDescription"),
    "not FMI": (lambda path: build_crane(path, 2, description="<html/>"), "crane.fmu is of FMI none"),
    "FMI 1": (lambda path: build_crane(path, 2, description=FMI1), "crane.fmu is of FMI 1.0; wanted FMI 2"),
}  # fmt: skip


@pytest.mark.parametrize("case", ARCHIVES)
def test_a_file_that_is_no_usable_fmu_is_one_line_from_every_command(
    case, monkeypatch, tmp_path, temporary, capsys
):
    build, message = ARCHIVES[case]
    build(tmp_path / "crane.fmu")
    code, out = run(monkeypatch, tmp_path, 2, "--no-isolate")
    assert not out.exists()
    assert code == 2
    lines = capsys.readouterr().err.splitlines()
    for command in ("validate", "info"):
        assert servobench(monkeypatch, "fmu", command, str(tmp_path / "crane.fmu")) == 2
        lines += capsys.readouterr().err.splitlines()
    assert len(lines) == 3
    assert all(line.startswith("servobench: ") and message in line for line in lines)
    assert list(tmp_path.rglob("evil.txt")) == []


def test_validate_loads_an_fmu_without_a_reference_run_and_says_so(
    output_of, monkeypatch, tmp_path
):
    path = tmp_path / "crane.fmu"
    build_crane(path, 2)
    # The crane has no ModelStructure
    monkeypatch.setattr("servobench.harness.apps.fmu.inspection.validate_by_fmpy", lambda _: [])
    assert "no reference run inside; it was loaded and made ready for a run\n" in output_of(
        "fmu", "validate", path
    )
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist() if "." in name}
    path.unlink()
    write(
        path,
        {name: b"text" if name.startswith("binaries") else each for name, each in contents.items()},
    )
    output = output_of("fmu", "validate", path, code=1)
    assert (
        "problem: it cannot be made ready for a run: the library in crane.fmu cannot be loaded"
        in output
    )
    assert "it was loaded" not in output


@pytest.mark.parametrize(
    ("version", "arguments", "more", "message"),
    [
        (2, {"folder": "riscv64-plan9"}, "", "has no library for this machine; wanted "),
        (3, {"description": SCHEDULED_ONLY}, "", "offers scheduled execution only; wanted co-simulation or model"),
        (2, {"description": IN_DEGREES}, "", "inputs names 'push.slew', whose unit is deg/s; wanted rad/s"),
        (2, {"description": SCALED.format("0.0174533")}, "", "'push.slew', whose unit is deg/s; wanted rad/s: convert"),
        (2, {"description": DIFFERENCE}, "", "'push.slew', whose unit is deg/s; wanted rad/s: convert"),
        (2, {"description": IN_METRES}, 'names.feature_unit = "mm"', "must be m, the unit of place.luff, got mm"),
        (2, {"description": SCALED.format("0.1")}, "", "'push.slew', whose unit is 0.1 × rad/s; wanted rad/s: convert"),
        (2, {}, "[parameters]\n'push.slew' = 2\n", "parameters names 'push.slew' as inputs does; each has its own"),
        (2, {}, "[parameters]\nquirk = 2\n", "crane.fmu returned something that is not finite for place.luff"),
        (3, {"description": describe_with(3, 'start="2"', 'start="3"')}, "",
         "reading wheel[1], wheel[2], wheel[3], … returned"),
        (3, {"description": describe_with(3, 'start="2"', 'start="two"')}, "", "a broken modelDescription.xml: "),
    ],
)  # fmt: skip
def test_an_fmu_that_does_not_fit_is_one_line(
    version, arguments, more, message, monkeypatch, tmp_path, temporary, capsys
):
    build_crane(tmp_path / "crane.fmu", version, **arguments)
    # A process of its own, which takes a second to start, passes on what an FMU says while it is run
    here = () if "quirk = 2" in more else ("--no-isolate",)
    code, out = run(monkeypatch, tmp_path, version, *here, more=more)
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("servobench: plant fmu:")
    assert message in line
    assert code == 2
    assert not out.exists()
