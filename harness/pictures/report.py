"""One self-contained page about a results folder: the analysis notebook, run on it and turned into HTML.

The notebook lies in `notebooks/` of the source tree and in `harness/notebooks/` of an installed package. Its results
folder is given by the environment variable SERVOBENCH_RESULTS. The page holds its pictures, tables and scripts itself;
it needs no network.
"""

from __future__ import annotations

import html
import os
import re
import sys
import tempfile
from pathlib import Path
from typing import Any

import nbformat
from jupyter_client.kernelspec import KernelSpec, KernelSpecManager
from jupyter_client.manager import AsyncKernelManager
from nbclient import NotebookClient
from nbclient.exceptions import CellControlSignal, DeadKernelError
from nbconvert.exporters import HTMLExporter

from servobench.harness.batch import results
from servobench.harness.config.settings import ConfigurationError

NAME = "report.html"
NOTEBOOK = "analysis.ipynb"
FOLDER_VARIABLE = "SERVOBENCH_RESULTS"
NOT_IN_PAGE = "notebook-only"  # tag of cells that say how to use the notebook
CELL_TIMEOUT = 600  # s
SLOW = 20.0  # s beyond which a report counts as slow

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<link rel="icon" href="data:,">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 1180px; margin: 0 auto; padding: 1.5rem; }}
h1 {{ font-size: 1.8rem; }}
h2 {{ margin-top: 2.8rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }}
nav a {{ margin-right: 1rem; white-space: nowrap; }}
a {{ color: #0060a8; }}
img {{ max-width: 100%; height: auto; }}
table {{ border-collapse: collapse; font-size: 13px; }}
th, td {{ padding: .25rem .6rem; }}
.output_png {{ margin: 1.2rem 0; }}
.anchor-link {{ display: none; }}
pre {{ white-space: pre-wrap; }}
footer {{ margin-top: 3rem; font-size: 13px; color: #666; }}
</style>
</head>
<body>
<nav>{contents}</nav>
{body}
<footer>Made by <code>servobench report</code> from the tables in <code>{folder}</code>.</footer>
</body>
</html>
"""


class ReportFailed(ConfigurationError):
    """The notebook could not be run; the message says which cell and why."""


def notebook_path() -> Path:
    """Return where the analysis notebook lies.

    Raises:
        ConfigurationError: it is in neither place.
    """
    package = Path(__file__).resolve().parents[1]
    for path in (package.parent / "notebooks" / NOTEBOOK, package / "notebooks" / NOTEBOOK):
        if path.is_file():
            return path
    raise ConfigurationError(f"the notebook {NOTEBOOK} is not beside the package; install servobench again")


def write_report(folder: Path, path: Path | None = None) -> Path:
    """Write the report on a results folder.

    Args:
        folder: a results folder.
        path: the page; by default `report.html` in the folder.

    Returns:
        The page's path.

    Raises:
        ConfigurationError: not a results folder, no run in it, or the notebook fails.
    """
    if results.load_runs(folder).empty:
        raise ConfigurationError(f"{folder} holds no finished run")
    target = path or folder / NAME
    page = _page(execute_notebook(folder), folder)
    partial = target.with_name(f".{target.name}")
    try:
        partial.write_text(page, encoding="utf-8")
        partial.replace(target)
    except OSError as error:
        raise ConfigurationError(f"report {target} cannot be written: {error.strerror}") from error
    return target


class _ThisPython(KernelSpecManager):
    """Starts kernels with the interpreter of this process, whatever kernels a user has registered."""

    def get_kernel_spec(self, kernel_name: str) -> KernelSpec:
        """Return how to start a kernel, whatever its name."""
        argv = [sys.executable, "-m", "ipykernel_launcher", "--log-level=ERROR", "-f", "{connection_file}"]
        return KernelSpec(argv=argv, display_name=kernel_name, language="python")


def _kernel_class(connection: Path) -> type[AsyncKernelManager]:
    """Return a manager of a kernel of this interpreter that talks over files beside `connection`."""

    class ThisKernel(AsyncKernelManager):
        def __init__(self, **settings: Any) -> None:  # noqa: ANN401 - handed on to traitlets
            super().__init__(
                kernel_spec_manager=_ThisPython(),
                connection_file=str(connection),
                transport="ipc" if os.name == "posix" else "tcp",  # such sockets are open to nobody else
                **settings,
            )

    return ThisKernel


def execute_notebook(folder: Path) -> Any:  # noqa: ANN401 - a notebook as nbformat has it, untyped
    """Return the analysis notebook with its outputs for a results folder.

    Raises:
        ReportFailed: a cell fails, or the kernel does not start.
    """
    text = notebook_path().read_text(encoding="utf-8")
    notebook: Any = nbformat.reads(text, as_version=4)  # type: ignore[no-untyped-call]
    # The kernel finds the packages that this process has found, wherever they are.
    paths = [str(Path(__file__).parents[3]), *filter(None, [os.environ.get("PYTHONPATH")])]
    environment = os.environ | {
        FOLDER_VARIABLE: str(folder.resolve()),
        "PYTHONPATH": os.pathsep.join(paths),
        "PYDEVD_DISABLE_FILE_VALIDATION": "1",
    }
    try:
        with tempfile.TemporaryDirectory(prefix="servobench-") as scratch:
            kernel = _kernel_class(Path(scratch) / "kernel.json")
            NotebookClient(notebook, timeout=CELL_TIMEOUT, kernel_manager_class=kernel).execute(env=environment)
    except (CellControlSignal, DeadKernelError, RuntimeError, OSError) as error:
        reason = re.sub(r"\x1b\[[0-9;]*m", "", str(error)).strip().splitlines() or [type(error).__name__]
        raise ReportFailed(f"report on {folder}: the notebook failed: {reason[-1]}") from error
    return notebook


def _page(notebook: Any, folder: Path) -> str:  # noqa: ANN401
    exporter: Any = HTMLExporter(  # type: ignore[no-untyped-call] # nbconvert leaves its constructors untyped
        template_name="basic",
        exclude_input=True,
        exclude_input_prompt=True,
        exclude_output_prompt=True,
    )
    notebook.cells = [cell for cell in notebook.cells if NOT_IN_PAGE not in cell.metadata.get("tags", [])]
    body, _ = exporter.from_notebook_node(notebook)
    headings = re.findall(r'<h2 id="([^"]+)">(.*?)<', body)
    contents = " ".join(f'<a href="#{anchor}">{text}</a>' for anchor, text in headings)
    name = html.escape(folder.resolve().name)
    return PAGE.format(title=f"servobench: {name}", contents=contents, body=body, folder=name)
