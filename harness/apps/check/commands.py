"""The commands `servobench new | check`: a controller or plant of your own."""

from __future__ import annotations

import keyword
import re
import sys
from importlib.resources import files
from pathlib import Path
from typing import Annotated

import typer

from servobench.harness.cli.options import option, switch
from servobench.harness.cli.terminal import FAILED, console, say
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import accessing, write_text

TEMPLATES = files("servobench.harness.apps.check") / "templates"
PREFIX = "test_"
NEXT = {  # kind of a new file -> the next commands
    "controller": ("check {}", "run --controller {} --plant kinematic"),
    "plant": ("check plant {}", "run --plant {}"),
}
COLOURS = {"ok": "green", "failed": "bold red", "note": "yellow"}


def new(
    kind: Annotated[str, typer.Argument(help="What to write: controller or plant.")],
    name: Annotated[
        str, typer.Argument(help="Name of the file and, as MyLaw for my_law, of the class in it.")
    ] = "",
    folder: Annotated[Path, option("FOLDER", "Folder for the files.")] = Path(),
    aids: Annotated[
        bool, switch("--aids", "A controller with the aids of the bench's methods.")
    ] = False,
) -> None:
    """Write a commented controller or plant, and its test."""
    from importlib.metadata import packages_distributions

    if kind not in NEXT:
        commands = " or ".join(f"servobench new {word} NAME" for word in NEXT)
        raise ConfigurationError(f"{kind!r} is nothing to begin with; the command is {commands}")
    if aids and kind != "controller":
        raise ConfigurationError(
            f"--aids are those of a controller; leave the option out for a {kind}"
        )
    module = name.removesuffix(".py")
    if (
        not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", module)
        or keyword.iskeyword(module)
        or module.startswith(PREFIX)
    ):
        raise ConfigurationError(
            f"the name must be one of a Python module, such as my_law, got {name!r}"
        )
    class_name = "".join(part[:1].upper() + part[1:] for part in module.split("_"))
    own = "aided_controller" if aids else kind
    wanted = {folder / f"{module}.py": own, folder / f"{PREFIX}{module}.py": f"{PREFIX}{kind}"}
    for path in wanted:
        if path.exists():
            raise ConfigurationError(
                f"{path} exists already and is left as it is; take another name or --folder"
            )
    if module in sys.stdlib_module_names or module in packages_distributions():
        raise ConfigurationError(
            f"a Python package is called {module}, which a file of this name would hide; take another"
        )
    with accessing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for path, template in wanted.items():
            text = (TEMPLATES / f"{template}.py.txt").read_text(encoding="utf-8")
            text = text.replace("{{module}}", module).replace("{{Class}}", class_name)
            write_text(path, text)
    file, test = wanted
    place = file if file.is_absolute() else f"./{file}"
    lines = [
        f"wrote {file} and {test}; next:",
        *(f"    servobench {command.format(place)}" for command in NEXT[kind]),
    ]
    say("\n".join(lines))


def check(
    subject: Annotated[
        list[str],
        typer.Argument(
            metavar="CONTROLLER | plant PLANT", help="As ./mine.py:Mine, or plant kinematic."
        ),
    ],
    limit: Annotated[float, option("SECONDS", "Time limit of one check [s].", min=1.0)] = 60.0,
) -> None:
    """Check a controller or a plant against its contract.

    Each failure names its remedy.
    """
    from rich.text import Text

    from servobench.harness.apps.check.controllers import check_controller
    from servobench.harness.apps.check.plants import check_plant
    from servobench.harness.apps.check.report import Finding
    from servobench.harness.apps.check.trial import run_checks

    if subject == ["plant"]:
        raise ConfigurationError(
            "check plant needs a plant, such as servobench check plant ./cell.py"
        )
    is_plant, name = subject[0] == "plant", subject[-1]
    if len(subject) != 1 + is_plant:
        raise ConfigurationError(
            f"check needs a controller, or the word plant and a plant, got {' '.join(subject)!r}"
        )
    checks = check_plant if is_plant else check_controller
    findings = []

    def hear(finding: Finding) -> None:
        findings.append(finding)
        verdict = f"{finding.verdict:7s}", COLOURS[finding.verdict]
        console.print(Text.assemble(verdict, f"{finding.check:15s}", finding.text), soft_wrap=True)

    run_checks(checks, name, limit, hear)
    failed = sum(finding.verdict == "failed" for finding in findings)
    say(
        f"{name}: "
        + (f"{failed} of {len(findings)} checks failed" if failed else "keeps its contract")
    )
    if failed:
        sys.exit(FAILED)
