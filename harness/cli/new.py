"""The command `servobench new`: a controller or a plant to begin with."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final

import typer

from servobench.harness.cli.terminal import say

TEMPLATES: Final = "servobench.harness.cli"
PREFIX: Final = "test_"
NEXT: Final = {  # what to do with a new file, by what it is
    "controller": ("check {}", "run --controller {} --plant kinematic"),
    "plant": ("check plant {}", "run --plant {}"),
}


def new(
    kind: Annotated[str, typer.Argument(help="What to write: controller or plant.")],
    name: Annotated[str, typer.Argument(help="Name of the file and, as MyLaw for my_law, of the class in it.")],
    folder: Annotated[Path, typer.Option(help="Folder for the files.")] = Path(),
) -> None:
    """Write a commented controller or plant, and its test."""
    from servobench.harness.config.settings import ConfigurationError
    from servobench.plant.contract.files import reason

    if kind not in NEXT:
        commands = " or ".join(f"servobench new {word} NAME" for word in NEXT)
        raise ConfigurationError(f"{kind!r} is nothing to begin with; the command is {commands}")
    module = name.removesuffix(".py")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", module) or keyword.iskeyword(module) or module.startswith(PREFIX):
        raise ConfigurationError(f"the name must be one of a Python module, such as my_law, got {name!r}")
    class_name = "".join(part[:1].upper() + part[1:] for part in module.split("_"))
    wanted = {folder / f"{module}.py": kind, folder / f"{PREFIX}{module}.py": f"{PREFIX}{kind}"}
    for path in wanted:
        if path.exists():
            raise ConfigurationError(f"{path} exists already and is left as it is; take another name or --folder")
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, template in wanted.items():
            text = (files(TEMPLATES) / "templates" / f"{template}.py.txt").read_text(encoding="utf-8")
            path.write_text(text.replace("{{module}}", module).replace("{{Class}}", class_name), encoding="utf-8")
    except OSError as error:
        raise ConfigurationError(f"{error.filename} cannot be written: {reason(error)}") from error
    file, test = wanted
    place = file if file.is_absolute() else f"./{file}"
    lines = [f"wrote {file} and {test}; next:", *(f"    servobench {command.format(place)}" for command in NEXT[kind])]
    say("\n".join(lines))
