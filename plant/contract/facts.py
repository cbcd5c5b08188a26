"""Facts that the package keeps as TOML files, among its data or beside the module that needs them."""

from importlib.resources import files
from pathlib import Path
from typing import Any

from servobench.plant.contract.files import Record, read_toml
from servobench.plant.contract.settings import with_tuples

DATA = Path(str(files("servobench.plant") / "data"))


def read_beside(module: str, name: str) -> Record:
    """Return the content of a TOML file that lies beside a module, given the module's `__file__`."""
    return read_toml("facts", Path(module).with_name(name))


def read_facts(name: str) -> Any:  # noqa: ANN401 - as the file has them
    """Return the content of the file of a name among the package's data, with tuples for lists."""
    return with_tuples(read_toml("facts", DATA / f"{name}.toml"))
