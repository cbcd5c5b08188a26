"""Executes the worked example and stores its outputs, which the site and a code host show.

    python docs/stored_notebook.py            # after a change of the example or of results
    python docs/stored_notebook.py --check    # a line for each output that does not come out again

Numbers may differ as another processor makes them, as in the stored tables; pictures are compared by their presence.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any, Final

import matplotlib
from IPython.core.interactiveshell import InteractiveShell
from IPython.utils.capture import capture_output
from matplotlib_inline.backend_inline import configure_inline_support

import stored_tables

EXAMPLE: Final = Path(__file__).with_name("worked_example.ipynb")
INLINE: Final = "module://matplotlib_inline.backend_inline"  # as in Jupyter
TEXT, PICTURE = "text/plain", "image/png"
SHOWN: Final = ("text/html", TEXT, PICTURE)  # kinds of output that are kept

Output = dict[str, Any]


def main() -> int:
    """Store the outputs, or return how many of the stored ones do not come out again."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--check",
        action="store_true",
        help="compare with the stored outputs instead of writing them",
    )
    check = parser.parse_args().check
    notebook = json.loads(EXAMPLE.read_text(encoding="utf-8"))
    codes = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    made = executed(["".join(cell["source"]) for cell in codes])
    if check:
        problems = [
            f"{cell['source'][0].strip()}: {texts(now)}, stored is {texts(cell['outputs'])}"
            for cell, now in zip(codes, made, strict=True)
            if not alike(texts(now), texts(cell["outputs"]))
        ]
        print("\n".join(problems) or "every stored output comes out again")  # noqa: T201 - the output of the command
        return len(problems)
    for count, (cell, now) in enumerate(zip(codes, made, strict=True), 1):
        cell |= {"outputs": now, "execution_count": count}
    EXAMPLE.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    return 0


def executed(codes: list[str]) -> list[list[Output]]:
    """Return the outputs of cells, carried out one after the other in one namespace.

    Raises:
        SystemExit: a cell failed.
    """
    shell = InteractiveShell.instance(colors="nocolor")
    matplotlib.use(INLINE)
    configure_inline_support(shell, INLINE)
    found = []
    for code in codes:
        with capture_output() as captured:
            shell.display_trap.hook = sys.displayhook  # also what the last line of the cell returns
            result = shell.run_cell(code)
        if not result.success:
            sys.exit(f"{code}\n{result.error_before_exec or result.error_in_exec!r}")
        kept = [
            {kind: each.data[kind] for kind in SHOWN if kind in each.data}
            for each in captured.outputs
        ]
        printed = (
            [{"output_type": "stream", "name": "stdout", "text": captured.stdout}]
            if captured.stdout
            else []
        )
        found.append(
            printed
            + [{"output_type": "display_data", "data": data, "metadata": {}} for data in kept]
        )
    return found


def texts(outputs: list[Output]) -> list[str]:
    """Return the texts of outputs; a picture has the name of its kind."""
    data = [each.get("data", {TEXT: each.get("text", "")}) for each in outputs]
    return [PICTURE if PICTURE in each else "".join(each[TEXT]) for each in data]


def alike(found: list[str], wanted: list[str]) -> bool:
    """Return whether outputs have the same words, and numbers that differ by little."""
    return len(found) == len(wanted) and all(map(stored_tables.alike, found, wanted))


if __name__ == "__main__":
    sys.exit(1 if main() else 0)
