"""Random calls of exported FMUs under the address and undefined-behaviour sanitizers: builds the driver and runs it."""

from __future__ import annotations

import re
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path

from kit.command import carried_out
from kit.controller_fmus import recorded
from servobench.fmus.export import ExportOptions, product
from servobench.fmus.product import Product

HERE = Path(__file__).parent
SANITIZED = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-fno-omit-frame-pointer")
TIMEOUT = 3600.0  # [s] of a process: a call that does not return is found
COMMON = ("-std=c11", "-O0", "-g", "-ffp-contract=off", "-Wall", "-Wextra")


@cache
def can_sanitize() -> bool:
    """Return whether this machine's compiler builds programs with sanitizers that run."""
    compiler = shutil.which("cc")
    if compiler is None:
        return False
    with tempfile.TemporaryDirectory() as folder:
        (Path(folder) / "main.c").write_text("int main(void) { return 0; }\n")
        built = carried_out(compiler, *SANITIZED, "main.c", "-o", "main", cwd=folder)
        return built.returncode == 0 and carried_out(f"{folder}/main").returncode == 0


def arm(version: int) -> Product:
    """Return the exported UR5."""
    return product(ExportOptions(version))


def controller(version: int, name: str = "ukf_mfac:published") -> Product:
    """Return an exported controller."""
    return recorded(name).product(version)


def build(folder: Path, made: Product, defect: str = "") -> Path:
    """Compile the driver with the sources of an FMU, without the check `defect`, to test the test."""
    version = made.fmi_version
    for name, text in made.sources().items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text if not defect else text.replace(defect, "0"))
    sources = folder / "sources"
    shutil.copy(HERE / "calls.h", sources)
    shutil.copy(HERE / f"calls{version}.c", sources)
    files = [f"calls{version}.c", *made.description.sources]
    command = [
        shutil.which("cc") or "cc",
        *COMMON,
        *SANITIZED,
        *files,
        "-o",
        str(folder / "calls"),
        "-lm",
    ]
    subprocess.run(command, cwd=sources, check=True)
    return folder / "calls"


def run(program: Path, calls: int, seed: int) -> tuple[int, int]:
    """Return how many calls were made and how many of them were refused.

    Raises:
        AssertionError: a sanitizer found something.
    """
    done = carried_out(program, calls, seed, errors="replace", timeout=TIMEOUT)
    assert done.returncode == 0, f"seed {seed}: {done.stderr[:3000]}"
    made, refused = re.fullmatch(r"(\d+) calls, (\d+) refused\n", done.stdout).groups()
    return int(made), int(refused)
