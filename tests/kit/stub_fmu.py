"""A small foreign FMU of FMI 2 for tests, with one fault or habit: a planar arm that follows speeds, and its tip."""

import shutil
import subprocess
import tempfile
import zipfile
from functools import cache
from pathlib import Path

from kit.foreign_fmu import SOURCES
from servobench.fmus.compiler import this_platform

MAPPING = 'file = "stub.fmu"\ninputs = ["u"]\njoints = ["q"]\nfeatures = ["y"]\n'
TARGET = ("--task", "target", "--set", "target.target=[0.1,0.75]")
PROBES = (
    "--mismatch",
    "none",
    "--set",
    "ukf_mfac.initial.source=probe",
    "--set",
    "ukf_mfac.aids.posture=false",
)
START = ' start="0"'
CAUSES = {"q": "output", "u": "input", "y": "output"}


def describe(more: str = "", interface: str = "") -> str:
    """Return the model description with attributes of co-simulation and elements before the variables."""
    variables = "".join(
        f'<ScalarVariable name="{name}[{i + 1}]" valueReference="{10 * (k + 1) + i}" causality="{cause}" '
        f'variability="continuous"><Real{START if cause == "input" else ""}/></ScalarVariable>'
        for k, (name, cause) in enumerate(CAUSES.items())
        for i in range(2)
    )
    outputs = "".join(f'<Unknown index="{i}"/>' for i in (1, 2, 5, 6))
    return (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="Stub" guid="g">'
        f'<CoSimulation modelIdentifier="stub" {interface}/>{more}<ModelVariables>{variables}</ModelVariables>'
        f"<ModelStructure><Outputs>{outputs}</Outputs></ModelStructure></fmiModelDescription>"
    )


@cache
def library(*macros: str) -> bytes:
    """Return the compiled stub with macros such as `AT_FREE=abort()`."""
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "stub.so"
        options = ["-shared", "-fPIC", "-O1", "-w", *(f"-D{macro}" for macro in macros), "-lm"]
        source = str(SOURCES / "stub2.c")
        subprocess.run(
            [shutil.which("cc") or "gcc", source, *options, "-o", str(target)], check=True
        )
        return target.read_bytes()


def build_stub(
    folder: Path,
    *macros: str,
    description: str = "",
    separator: str = "/",
    files: tuple[str, ...] = (),
) -> Path:
    """Write `stub.fmu` and its mapping into a folder, and return the place of the mapping."""
    names = {"modelDescription.xml": (description or describe()).encode()}
    names[
        separator.join(("binaries", this_platform().folder(2), f"stub{this_platform().suffix}"))
    ] = library(*macros)
    names |= {separator.join(("resources", name)): b"1" for name in files}
    with zipfile.ZipFile(folder / "stub.fmu", "w") as archive:
        for name, content in names.items():
            archive.writestr(zipfile.ZipInfo(name), content)
    mapping = folder / "stub.toml"
    mapping.write_text(MAPPING)
    return mapping
