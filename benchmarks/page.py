"""Writes docs/performance.md from page.md: each line `<!-- NAME -->` becomes the output of the benchmark NAME.

    make benchmark                                                   # a quarter of an hour on two quiet processors
    python benchmarks/page.py --against 0.1.0=/path/to/a/checkout    # with an older version beside this one
    python benchmarks/page.py --quick --out page                     # tests the page, not the speed
    python benchmarks/page.py --only scaling                         # all else, the date too, is that of the last time

What each benchmark prints is kept in build/benchmarks, so that one that fails loses none of the others.

An older checkout that needs other libraries has its environment in `.venv`.
"""

from __future__ import annotations

import datetime
import os
import platform
import re
import subprocess
import sys
import time
from pathlib import Path

from threadpoolctl import threadpool_info

import measuring
from servobench.harness.config.installation import installed_version

ROOT = Path(__file__).resolve().parents[1]
LIBRARIES = "numpy", "casadi", "fmpy", "pybullet", "mujoco", "distributed", "filterpy", "do-mpc"
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def run(script: str, *options: str) -> str | None:
    """Return what a benchmark prints, None if it fails."""
    environment = {
        **os.environ,
        **dict.fromkeys(THREADS, "1"),
        "PYTHONPATH": str(ROOT / ".package"),
    }
    command = [sys.executable, str(ROOT / "benchmarks" / f"{script}.py"), *options]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        sys.stderr.write(f"{script} failed: {done.stderr.strip()}\n")
        return None
    return "\n".join(
        line for line in done.stdout.splitlines() if not line.startswith("pybullet build")
    ).strip()


def machine() -> str:
    """Return machine, date and versions."""
    lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    versions = {"Python": platform.python_version()} | {
        library: installed_version(library) for library in LIBRARIES
    }
    return (
        f"Machine: {next(names, platform.machine())}, {os.cpu_count()} processors, {platform.system()} "
        f"{platform.machine()}; {datetime.datetime.now(tz=datetime.UTC):%Y-%m-%d}.\n"
        + ", ".join(f"{name} {found}" for name, found in versions.items() if found) + ".\n"
        + "; ".join(dict.fromkeys(map(blas, threadpool_info()))) + "."
    )  # fmt: skip


def blas(library: dict[str, object]) -> str:
    """Return the name, version and kernel of a library of linear algebra."""
    return f"{library['internal_api']} {library['version']}, kernel {library.get('architecture', 'unknown')}"


def main() -> None:
    """Write the page."""
    options = measuring.options(
        __doc__,
        quick=measuring.QUICK,
        against={"nargs": "*", "default": [], "metavar": "NAME=PATH", "help": "older checkouts"},
        out={"type": Path, "default": ROOT / "docs"},
        only={
            "nargs": "*",
            "metavar": "SCRIPT",
            "help": "benchmarks to run, such as limits; default: all",
        },
    )
    pictures = options.out / "pictures"
    extra = {
        each: ["--picture", f"{pictures}/performance_{each}.png"] for each in ("shares", "scaling")
    }
    extra["throughput"] = ["--against", *options.against]
    extra["waits"] = ["--against", *options.against]
    kept, failed = (options.out if options.quick else ROOT / "build") / "benchmarks", []
    kept.mkdir(parents=True, exist_ok=True)

    def filled(marker: re.Match[str]) -> str:
        script, began = marker[1], time.perf_counter()
        last = kept / f"{script}.md"
        if not options.only or script in options.only:
            quick = ["--quick"] if options.quick else []
            printed = (
                machine() if script == "machine" else run(script, *extra.get(script, []), *quick)
            )
            sys.stderr.write(f"{script}: {time.perf_counter() - began:.0f} s\n")
            if printed is None:
                failed.append(script)
            else:
                last.write_text(printed, encoding="utf-8")
        return last.read_text(encoding="utf-8") if last.exists() else ""

    template = Path(__file__).with_name("page.md").read_text(encoding="utf-8")
    page = re.sub(r"^<!-- (\w+) -->$", filled, template, flags=re.MULTILINE)
    options.out.mkdir(parents=True, exist_ok=True)
    (options.out / "performance.md").write_text(page, encoding="utf-8")
    if failed:
        sys.exit(f"failed: {', '.join(failed)}")


if __name__ == "__main__":
    main()
