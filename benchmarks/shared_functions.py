"""The functions that one run and many side by side both call, by tracing: no hot loop is a copy of another one."""

from __future__ import annotations

import sys
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from types import FrameType

import servobench
from measuring import METHODS, asked_to_be_quick, resolved_runs, table
from servobench.harness.run.episode import carry_out, carry_out_together

PLANTS = ("kinematic", "fmu")
PACKAGE = Path(servobench.__file__).resolve().parents[2]

Functions = dict[str, set[str]]  # by module


def called_by(action: Callable[[], object]) -> Functions:
    """Return the functions of the package that are called while an action goes on."""
    codes = set()

    def note(frame: FrameType, event: str, _: object) -> None:
        if event == "call":
            codes.add(frame.f_code)

    sys.setprofile(note)
    try:
        action()
    finally:
        sys.setprofile(None)
    functions: Functions = defaultdict(set)
    for code in codes:
        path = Path(code.co_filename).resolve()
        named = not code.co_name.startswith("<") and not code.co_filename.startswith("<")
        if named and path.is_relative_to(PACKAGE) and ".venv" not in path.parts:
            functions[path.relative_to(PACKAGE).as_posix()].add(code.co_qualname.replace(".<locals>", ""))
    return functions


def listed(functions: Functions, folder: str) -> str:
    """Return the functions of the modules of a folder, with the names of the modules."""
    own = {module: names for module, names in sorted(functions.items()) if Path(module).parent.as_posix() == folder}
    return "; ".join(f"{Path(module).stem}: " + ", ".join(f"`{name}`" for name in sorted(names))
                     for module, names in own.items() if names)  # fmt: skip


def main() -> None:
    """Print a table by folder, and the names of the functions that both call."""
    plants = PLANTS[: 1 if asked_to_be_quick(__doc__) else None]
    runs = [resolved_runs(plant, method, 2, duration=2.0) for plant in plants for method in METHODS]
    for pair in runs:  # imports and caches that only the first run fills
        carry_out(pair[0], steps=False)
        carry_out_together(pair)
    one = called_by(lambda: [carry_out(pair[0], steps=False) for pair in runs])
    many = called_by(lambda: [carry_out_together(pair) for pair in runs])
    both = {module: names & many.get(module, set()) for module, names in one.items()}
    sides = [{module: names - both.get(module, set()) for module, names in side.items()} for side in (one, many)]
    folders = sorted({Path(module).parent.as_posix() for module in (*one, *many)})
    counts = {folder: sum(len(names) for module, names in both.items() if Path(module).parent.as_posix() == folder)
              for folder in folders}  # fmt: skip
    rows = [[f"`{folder}`", counts[folder], *(listed(side, folder) for side in sides)] for folder in folders]
    print(table(["folder", "functions that both call", "only a single run", "only runs side by side"], rows))
    print(f"<details><summary>The {sum(counts.values())} functions that both call</summary>\n")
    print(table(["folder", "functions"], [[f"`{folder}`", listed(both, folder)] for folder in folders]))
    print("</details>\n")


if __name__ == "__main__":
    main()
