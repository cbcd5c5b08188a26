"""A foreign FMU for tests: a planar arm of two joints with other names and sizes, from C that shares nothing with ours.

Its parameter `quirk` makes it misbehave: 1 step fails, 2 result is NaN, 3 every step ends half way, 4 a step makes no
progress, 5 initialisation fails, 6 it asks to end the simulation (FMI 3), 7 result becomes NaN,
8 every step ends after 10 µs, 9 a step reports a fatal error. It counts calls of Terminate, and calls after a fatal
error.
"""

import io
import json
import shutil
import subprocess
import tempfile
import zipfile
from functools import cache
from pathlib import Path

from servobench.fmus.compiler import this_platform

SOURCES = Path(__file__).parent / "foreign_fmu_sources"
STARTS = {"push": (0.0, 0.0), "arm": (0.5, 0.4)}
ROLES = {  # names of variables by role, of each version
    version: {
        role: tuple(f"{name}{part}" for part in parts)
        for role, name in (("inputs", "push"), ("joints", "wheel"), ("features", "place"))
    }
    for version, parts in ((2, (".slew", ".luff")), (3, ("",)))
}
SCALARS = [
    ("wheel", 10, "output"),
    ("push", 20, "input"),
    ("place", 30, "output"),
    ("arm", 40, "parameter"),
]


def describe_exchange(derivatives: bool = True) -> str:
    """Return the model description of FMI 2 with a model-exchange side, whose states are the joints."""
    text = describe(2)
    names = ("wheel.slew", "wheel.luff")
    rates = "".join(
        _scalar(f"der({name})", 60 + i, "", f'<Real derivative="{i + 1}"/>')
        for i, name in enumerate(names)
    )
    first = text.count("<ScalarVariable") + 1
    outputs, rows = "".join(map(_unknown, (1, 2, 5, 6))), "".join(map(_unknown, (first, first + 1)))
    sections = {"Outputs": outputs, "Derivatives": rows, "InitialUnknowns": outputs + rows}
    structure = "".join(f"<{name}>{unknowns}</{name}>" for name, unknowns in sections.items())
    provides = f'providesDirectionalDerivative="{str(derivatives).lower()}"'
    exchange = f'<ModelExchange modelIdentifier="crane" {provides}/>'
    text = text.replace("<CoSimulation", f"{exchange}<CoSimulation").replace(
        "</ModelVariables>", f"{rates}</ModelVariables>"
    )
    return text.replace("<ModelStructure/>", f"<ModelStructure>{structure}</ModelStructure>")


def mapping(version: int) -> str:
    """Return the mapping of `crane.fmu` in TOML."""
    return "\n".join(
        [
            'file = "crane.fmu"',
            *(f"{role} = {json.dumps(names)}" for role, names in ROLES[version].items()),
            "",
        ]
    )


def _scalar(name: str, reference: int, attributes: str, kind: str) -> str:
    """Return a variable of FMI 2 with the element of its type."""
    head = f'<ScalarVariable name="{name}" valueReference="{reference}" {attributes}'
    return f"{head.rstrip()}>{kind}</ScalarVariable>"


def _unknown(index: int) -> str:
    return f'<Unknown index="{index}"/>'


def describe(version: int) -> str:
    """Return the model description; FMI 3 shows arrays whose size is a structural parameter, FMI 2 scalars."""
    variability = {"parameter": "tunable", "input": "continuous", "output": "continuous"}
    rows = []
    for name, reference, causality in SCALARS:
        common = f'causality="{causality}" variability="{variability[causality]}"'
        starts = STARTS.get(name)
        if version == 3:
            inner = '<Dimension valueReference="60"/>'
            start = f'start="{starts[0]} {starts[1]}"' if starts else ""
            head = f'<Float64 name="{name}" valueReference="{reference}" {common} {start}>'
            rows.append(f"{head}{inner}</Float64>")
        else:
            reals = [f'<Real start="{start}"/>' for start in starts] if starts else ["<Real/>"] * 2
            parts = zip(("slew", "luff"), reals, strict=True)
            rows += [
                _scalar(f"{name}.{part}", reference + i, common, real)
                for i, (part, real) in enumerate(parts)
            ]
    if version == 3:
        rows.append(
            '<Float64 name="quirk" valueReference="50" causality="parameter" variability="tunable" start="0"/>'
        )
        rows.append(
            '<UInt64 name="size" valueReference="60" causality="structuralParameter" variability="fixed" start="2"/>'
        )
        common = 'causality="parameter" variability="fixed"'
        rows += [
            f'<Int8 name="gear" valueReference="70" {common} start="1"/>',
            f'<Boolean name="on" valueReference="80" {common} start="true"/>',
            f'<String name="mood" valueReference="90" {common}><Start value=""/></String>',
            f'<Float32 name="trim" valueReference="100" {common} start="1"/>',
            '<Float32 name="shade" valueReference="110" causality="output"><Dimension start="2"/></Float32>',
            '<UInt64 name="samples" valueReference="120" causality="structuralParameter" start="1"/>',
            '<Float64 name="probe" valueReference="130" causality="output"><Dimension valueReference="120"/></Float64>',
        ]
        head = 'fmiVersion="3.0" modelName="Crane" instantiationToken="x"'
    else:
        tunable, fixed = (
            f'causality="parameter" variability="{word}"' for word in ("tunable", "fixed")
        )
        rows += [
            _scalar("quirk", 50, tunable, '<Real start="0"/>'),
            _scalar("gear", 70, tunable, '<Integer start="1"/>'),
            _scalar("on", 80, fixed, '<Boolean start="true"/>'),
            _scalar("mood", 90, fixed, '<String start=""/>'),
        ]
        head = 'fmiVersion="2.0" modelName="Crane" guid="x"'
    return (
        f'<?xml version="1.0"?><fmiModelDescription {head}><CoSimulation modelIdentifier="crane"/>'
        f"<ModelVariables>{''.join(rows)}</ModelVariables><ModelStructure/></fmiModelDescription>"
    )


def describe_with(version: int, old: str, new: str) -> str:
    """Return the model description with `new` in place of `old`, which it has to hold."""
    text = describe(version)
    assert old in text
    return text.replace(old, new)


@cache
def library(version: int, name: str = "crane") -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / f"{name}.so"
        arguments = [
            "-shared",
            "-fPIC",
            "-O1",
            str(SOURCES / f"{name}{version}.c"),
            "-o",
            str(target),
            "-lm",
        ]
        subprocess.run([shutil.which("cc") or "gcc", *arguments], check=True)
        return target.read_bytes()


def build_crane(
    path: Path, version: int, *, folder: str | None = None, description: str | None = None
) -> Path:
    """Write the foreign FMU to `path`."""
    place = folder or this_platform().folder(version)
    with zipfile.ZipFile(path, "w") as archive:
        # Without the time: equal content is unpacked once.
        archive.writestr(zipfile.ZipInfo("modelDescription.xml"), description or describe(version))
        archive.writestr(
            zipfile.ZipInfo(f"binaries/{place}/crane{this_platform().suffix}"), library(version)
        )
    return path


def build_pilot(path: Path) -> Path:
    """Write a foreign controller of the crane, of FMI 2, with names of its own, to `path`."""
    reals = [(f"{name}.{part}", causality) for name, causality in
             (("goal", "input"), ("hook", "input"), ("angle", "input"), ("rate", "output"))
             for part in ("slew", "luff")]  # fmt: skip
    rows = [
        _scalar(name, k, f'causality="{causality}"', "<Real/>")
        for k, (name, causality) in enumerate(reals)
    ]
    rows.append(
        _scalar("gain", 8, 'causality="parameter" variability="tunable"', '<Real start="2"/>')
    )
    discrete = 'causality="input" variability="discrete"'
    rows += [
        _scalar(f"clear.{part}", 20 + k, discrete, "<Boolean/>")
        for k, part in enumerate(("slew", "luff"))
    ]
    description = (
        '<?xml version="1.0"?><fmiModelDescription fmiVersion="2.0" modelName="Pilot" guid="y">'
        f'<CoSimulation modelIdentifier="pilot"/><ModelVariables>{"".join(rows)}</ModelVariables>'
        "<ModelStructure/></fmiModelDescription>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(zipfile.ZipInfo("modelDescription.xml"), description)
        file = f"binaries/{this_platform().folder(2)}/pilot{this_platform().suffix}"
        archive.writestr(zipfile.ZipInfo(file), library(2, "pilot"))
    return path


def packed(version: int, method: int) -> bytes:
    """Return an archive of an FMU whose library is none."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", method) as archive:
        archive.writestr("modelDescription.xml", describe(version))
        archive.writestr("binaries/linux64/crane.so", b"\x7fELF" + bytes(64))
        archive.writestr("resources/numbers.csv", "1,2,3\n" * 20)
    return content.getvalue()
