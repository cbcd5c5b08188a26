"""The command `servobench new`: a controller to begin with."""

from __future__ import annotations

import keyword
import re
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Final

import typer

from servobench.harness.cli.terminal import console

TEMPLATES: Final = "servobench.harness.cli"
PREFIX: Final = "test_"

KINDS: Final = ("controller",)


def new(
    kind: Annotated[str, typer.Argument(help="What to begin: controller.")],
    name: Annotated[str, typer.Argument(help="Name of the file and, as MyLaw for my_law, of the class in it.")],
    folder: Annotated[Path, typer.Option(help="Folder for the files.")] = Path(),
) -> None:
    """Write a commented controller that runs, and its test beside it."""
    from servobench.harness.config.settings import ConfigurationError

    if kind not in KINDS:
        raise ConfigurationError(f"{kind!r} is nothing to begin with; the command is servobench new controller NAME")
    module = name.removesuffix(".py")
    if not re.fullmatch(r"[A-Za-z][A-Za-z0-9_]*", module) or keyword.iskeyword(module) or module.startswith(PREFIX):
        raise ConfigurationError(f"the name must be one of a Python module, such as my_law, got {name!r}")
    class_name = "".join(part[:1].upper() + part[1:] for part in module.split("_"))
    wanted = {folder / f"{module}.py": "controller", folder / f"{PREFIX}{module}.py": f"{PREFIX}controller"}
    for path in wanted:
        if path.exists():
            raise ConfigurationError(f"{path} exists already and is left as it is; take another name or --folder")
    folder.mkdir(parents=True, exist_ok=True)
    for path, template in wanted.items():
        text = (files(TEMPLATES) / "templates" / f"{template}.py.txt").read_text(encoding="utf-8")
        path.write_text(text.replace("{{module}}", module).replace("{{Class}}", class_name), encoding="utf-8")
    file, test = wanted
    place = file if file.is_absolute() else f"./{file}"
    console.print(
        f"wrote {file} and {test}; next:\n"
        f"    servobench check {place}\n"
        f"    servobench run --controller {place} --plant kinematic",
        soft_wrap=True, markup=False, highlight=False,
    )  # fmt: skip
