"""Writes docs/performance.md with its pictures: every benchmark in turn, one command.

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
import subprocess
import sys
import tarfile
import tempfile
import time
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
BEFORE = "d7032c3"  # the last commit in which every run was carried out by itself
LIBRARIES = (
    "numpy", "scipy", "casadi", "daqp", "fmpy", "pybullet", "mujoco", "pandas", "distributed", "filterpy", "do-mpc",
)  # fmt: skip
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Section(NamedTuple):
    """A part of the page, from the output of some scripts."""

    title: str
    scripts: tuple[str, ...]
    text: str


SECTIONS = (
    Section("Throughput", ("throughput",), """\
Processor time of a control period: robots under the mismatch `moderate`, task `random`, one worker. In a sweep, the
building, judging and writing of runs are included, the start-up of the command is not. Alone, a run also has its steps
in a table. A ratio is the older version's time over the present one: above 1 the present version is faster."""),
    Section("Limits", ("limits",), """\
What the arithmetic alone costs: `benchmarks/bare_loop.c` has the plant, the filter and the law of `kinematic` with
`ukf_mfac` and nothing else: no checks, no log, no truth beside the observation, no judging. `benchmarks/limits.py` has
the same in numpy, for which every run has the same arm."""),
    Section("Where the time goes", ("shares",), """\
Processor time of a period by part, on `kinematic`. Functions are wrapped from outside, which adds some µs to a period
of a single run; building and judging are spread over the periods of the run. Estimator and law together are the step of
a controller."""),
    Section(
        "Beside other tools",
        ("fmu_step", "ukf_update", "mpc_step", "bullet_period", "mujoco_period", "engines"),
        """\
Each table compares within one process, in turns: calls into an FMU with fmpy, the unscented filter with filterpy, the
predictive law with do-mpc and IPOPT, and the rendered plant with a loop over PyBullet in the manner of Gymnasium. The
last two are how far `mujoco` is from `bullet` under the same commands and in the same images."""),
    Section("Cost against size", ("scaling",), """\
The exponent p is that of the fit cost = a sizeᵖ; −1 for runs side by side would mean that further runs cost nothing.
Dotted lines are single runs, the others blocks of 128. Joints and horizon are measured on a linear robot y = J q."""),
    Section("Towards 1,000 cores", ("growth",), """\
Measured with a Dask scheduler and one or two workers on this machine, whose processors they share with the scheduler
and the parent; the workers keep freed memory ([experiments](experiments.md#sweeps)).
**Everything beyond two workers is an estimate**: what the workers can do, as fast as here and with full
blocks of 128 runs, or what the busiest single process beside them can, if that is less. It leaves out the network
between machines and workers that differ in speed."""),
    Section("One formula for one run and for many", ("shared_functions",), """\
Traced over the five methods on `kinematic` and `fmu`: what a run by itself calls, and what runs side by side call.
Plants, estimators and laws are the same functions. Only one of the two calls the log of diagnostics, or the
book-keeping of runs that end early."""),
)  # fmt: skip


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


def header(compared: bool) -> str:
    """Return the top of the page: machine, date and versions."""
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
        "# Performance\n\nWritten by `make benchmark`; ratios within one run mean more than absolute times.\n"
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
        pages = [header(compared=bool(before))]
        checkouts = [*options.against, *(f"{name}={path}" for name, path in before.items())]
        extra = {
            name: ["--picture", f"{options.out}/pictures/performance_{name}.png"] for name in ("shares", "scaling")
        }
        extra |= {"throughput": ["--against", *checkouts]}
        extra["shares"] += ["--before", *map(str, before.values())] if before else []
        for title, scripts, text in SECTIONS:
            pages.append(f"## {title}\n\n{text}")
            for script in (each for each in scripts if each in (options.only or scripts)):
                began = time.perf_counter()
                pages.append(run(script, *extra.get(script, []), *(["--quick"] if options.quick else [])))
                sys.stderr.write(f"{script}: {time.perf_counter() - began:.0f} s\n")
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "performance.md").write_text("\n\n".join(pages) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
