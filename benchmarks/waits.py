"""What a user waits for: seconds by the wall clock of whole commands, with all processors, beside older checkouts.

    python benchmarks/waits.py                                  # this checkout
    python benchmarks/waits.py --against before=/path/to/it     # a checkout with an environment in .venv, in turn

Each command runs once to fill caches and is timed then, a short one five times in turn: the median counts. A command
that a checkout does not know is a dash. Close other programs: they double these times.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from measuring import QUICK, options, table

HERE = Path(__file__).resolve().parents[1]
EQUIPPED = "regression_mfac,rbfnn_mfac,ukf_mfac,ukf_mpc,rbf_pid"
LOG = "log"  # folder of the run that is identified
COMMANDS: dict[str, str] = {
    "first run, its table": "run --plant kinematic --no-figures --out {out}",
    "first run, with figures": "run --plant kinematic --out {out}",
    "list of controllers": "controllers",
    "sweep, five equipped methods × 1,000 robots": (
        f"sweep --plants kinematic --controllers {EQUIPPED} --seeds {{robots}} --out {{out}}"
    ),
    "sweep, 100 rendered runs": (
        "sweep --plants bullet --controllers ukf_mfac --tasks exp2 --seeds {rendered} --out {out}"
    ),
    "suite, three challenges, one method × 20 robots": (
        "suite --plants kinematic --challenges severe,gears50,zeros90 --controllers regression_mfac "
        "--seeds {few} --out {out}"
    ),
    "tune, one method × 10 trials": "tune --controllers ukf_mfac --trials {trials} --out {out}",
    "identify, one log": f"identify {LOG} --out {{out}}.toml",
    "export of an equipped controller as FMU": "fmu export --controller regression_mfac -o {out}.fmu",
}
# Of the process that writes the page: its packages would come before those of a checkout, and without bytecode each
# command would compile all modules of a checkout anew.
OF_THE_PAGE = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
ALL = {"robots": 1000, "rendered": 100, "few": 20, "trials": 10}
FEW = {"robots": 2, "rendered": 1, "few": 1, "trials": 1}
SHORT = 5.0  # [s] commands below this are timed several times: a wait of a second varies by a tenth
TIMES = 5
LOGGED = f"run --plant kinematic --controller {HERE}/docs/examples/excite.py --task circle --no-figures --out {LOG}"


def seconds(checkout: Path, command: str, folder: Path) -> float | None:
    """Return the wall-clock time of a command of a checkout [s], None if it fails."""
    program = [checkout / ".venv" / "bin" / "servobench", *command.split()]
    own = {name: value for name, value in os.environ.items() if name not in OF_THE_PAGE}
    began = time.perf_counter()
    done = subprocess.run(program, env=own, cwd=folder, capture_output=True, check=False)
    if done.returncode:
        return None
    return time.perf_counter() - began


def middle(times: Iterable[float | None]) -> float | None:
    """Return the median of times [s], None if the command failed."""
    found = [time_taken for time_taken in times if time_taken is not None]
    return statistics.median(found) if found else None


def first_commands(checkout: Path) -> list[str]:
    """Return the commands of `make run` of a checkout."""
    made = subprocess.run(
        ["make", "--dry-run", "run"], cwd=checkout, capture_output=True, text=True, check=True
    )
    lines = made.stdout.replace("\\\n", " ").splitlines()
    program = ".venv/bin/servobench "
    return [line.removeprefix(program) for line in lines if line.startswith(program)]


def shown(time_taken: float | None) -> str:
    """Return a time [s] for the table."""
    if time_taken is None:
        return "–"
    return f"{time_taken:.1f} s"


def main() -> None:
    """Print the table."""
    given = options(
        __doc__,
        quick=QUICK,
        against={"nargs": "*", "default": [], "metavar": "NAME=PATH", "help": "older checkouts"},
    )
    older = dict(each.split("=", 1) for each in given.against)
    checkouts = {name: Path(path).resolve() for name, path in older.items()} | {"now": HERE}
    sizes = FEW if given.quick else ALL
    taken: dict[str, list[float | None]] = {}
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        seconds(HERE, LOGGED, folder)
        for label, template in COMMANDS.items():

            def timed(name: str, attempt: int, template: str = template) -> float | None:
                command = template.format(out=f"{name}_{len(taken)}_{attempt}", **sizes)
                return seconds(checkouts[name], command, folder)

            first = [timed(name, 0) for name in checkouts]
            if given.quick:
                taken[label] = first
                continue
            again = TIMES if max(filter(None, first), default=0.0) < SHORT else 1
            rounds = [
                [timed(name, attempt) for name in checkouts] for attempt in range(1, again + 1)
            ]
            taken[label] = [middle(times) for times in zip(*rounds, strict=True)]
        if not given.quick:
            taken["`make run`, installed"] = [
                sum(
                    seconds(checkout, command, folder) or 0.0
                    for command in first_commands(checkout)
                )
                for checkout in checkouts.values()
            ]
    rows = [[label, *map(shown, times)] for label, times in taken.items()]
    print(table(["what", *checkouts], rows))


if __name__ == "__main__":
    main()
