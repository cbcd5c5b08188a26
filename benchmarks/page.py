"""Writes docs/performance.md from page.md: each line `<!-- NAME -->` becomes the output of the benchmark NAME.

    make benchmark                                                   # a quarter of an hour on two quiet processors
    python benchmarks/page.py --against 0.1.0=/path/to/a/checkout    # with a further older version beside this one
    python benchmarks/page.py --quick --out page                     # tests the page, not the speed

The commit before runs advanced side by side is taken from the history of this checkout, if it is there. An older
checkout that needs other libraries has its environment in `.venv`.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import io
import os
import platform
import re
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
BEFORE = "d7032c3"  # the last commit in which every run was carried out by itself
LIBRARIES = (
    "numpy", "scipy", "casadi", "daqp", "fmpy", "pybullet", "mujoco", "pandas", "distributed", "filterpy", "do-mpc",
)  # fmt: skip
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def run(script: str, *options: str) -> str:
    """Return what a benchmark prints.

    Raises:
        SystemExit: it failed.
    """
    environment = {**os.environ, **dict.fromkeys(THREADS, "1"), "PYTHONPATH": str(ROOT / ".package")}
    command = [sys.executable, str(ROOT / "benchmarks" / f"{script}.py"), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(f"{script} failed: {done.stderr.strip()}")
    return "\n".join(line for line in done.stdout.splitlines() if not line.startswith("pybullet build")).strip()


@contextlib.contextmanager
def commit_before() -> Iterator[dict[str, Path]]:
    """Yield a folder with the commit before, by its name on the page; nothing where the history is not there."""
    archive = subprocess.run(["git", "archive", BEFORE], cwd=ROOT, capture_output=True, check=False)
    if archive.returncode:
        yield {}
        return
    with tempfile.TemporaryDirectory(prefix="servobench-") as scratch:
        with tarfile.open(fileobj=io.BytesIO(archive.stdout)) as files:
            files.extractall(scratch, filter="data")
        yield {BEFORE: Path(scratch)}


def machine(compared: bool) -> str:
    """Return machine, date and versions."""
    name = platform.processor() or platform.machine()
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        name = next(line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    versions = [f"Python {platform.python_version()}"]
    for library in LIBRARIES:
        with contextlib.suppress(PackageNotFoundError):
            versions.append(f"{library} {version(library)}")
    before = f"{BEFORE} is the last commit before runs advanced side by side."
    return (
        f"Machine: {name}, {os.cpu_count()} processors, {platform.system()} {platform.machine()}; "
        f"{datetime.datetime.now(tz=datetime.UTC):%Y-%m-%d}.\n{', '.join(versions)}.\n"
        + (before if compared else f"The comparison with the commit {BEFORE} is left out: the history is not there.")
    )


def main() -> None:
    """Write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--against", nargs="*", default=[], metavar="NAME=PATH", help="further older checkouts")
    parser.add_argument("--quick", action="store_true", help="test the page, not the speed")
    parser.add_argument("--out", type=Path, default=ROOT / "docs")
    parser.add_argument("--only", nargs="*", metavar="SCRIPT", help="benchmarks to run, such as limits; default: all")
    options = parser.parse_args()
    with commit_before() as before:
        checkouts = [*options.against, *(f"{name}={path}" for name, path in before.items())]
        pictures = options.out / "pictures"
        extra = {each: ["--picture", f"{pictures}/performance_{each}.png"] for each in ("shares", "scaling")}
        extra["throughput"] = ["--against", *checkouts]

        def filled(marker: re.Match[str]) -> str:
            script = marker[1]
            if script == "machine":
                return machine(compared=bool(before))
            if options.only and script not in options.only:
                return ""
            began = time.perf_counter()
            printed = run(script, *extra.get(script, []), *(["--quick"] if options.quick else []))
            sys.stderr.write(f"{script}: {time.perf_counter() - began:.0f} s\n")
            return printed

        template = Path(__file__).with_name("page.md").read_text(encoding="utf-8")
        page = re.sub(r"^<!-- (\w+) -->$", filled, template, flags=re.MULTILINE)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "performance.md").write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
