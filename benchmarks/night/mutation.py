"""Mutation testing: whether the unit tests of a module notice small faults in it; `python -m night.mutation`.

A seeded sample of the mutants of each group of modules (`night.mutants`) meets the group's unit tests; the score is the
share that fails them. What survives is listed, with its line.

Nothing on disk is changed. The tests are collected once, and each is run once to know which lines it reaches, it or its
fixtures: no other test can notice a fault in a line. Each mutant is a forked process in which the functions of the
module get the changed code; the tests that reach its line follow, the quickest first, until one fails. Where the fault
is outside of functions, everything is imported anew from the changed tree, and all tests follow. That is why no tool of
the trade is used here: cosmic-ray writes the mutants into the working tree and starts an interpreter for each, which
costs more than most of these tests; mutmut finds modules by their paths, and the links in `.package` give them other
names.
"""

from __future__ import annotations

import argparse
import gc
import os
import random
import resource
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest
from hypothesis import Phase, settings

from night.children import answered, ended
from night.mutants import ANEW, Changed, Imported, Mutant, mutants

ROOT = Path(__file__).parents[2]

GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {  # name -> modules, unit tests
    "kinematics": (
        ("plant/robot/arm.py", "plant/robot/hand_eye.py"),
        ("plant/test_arm.py", "plant/test_plant_lanes.py", "plant/test_setups.py"),
    ),
    "estimators": (
        ("controllers/estimators/*.py",),
        ("controllers/test_estimators.py", "controllers/test_rbf.py", "controllers/test_correntropy.py",
         "controllers/test_robust_filter.py"),
    ),
    "laws": (
        ("controllers/laws/*.py", "controllers/laws/mpc/*.py", "controllers/periods.py"),
        ("controllers/test_pid.py", "controllers/test_mfac.py", "controllers/test_servo.py",
         "controllers/test_periods.py", "controllers/test_rbfnn.py", "controllers/test_mpc.py",
         "controllers/test_mpc_optimality.py"),
    ),
    "metrics": (
        ("harness/run/metrics.py",),
        ("harness/test_metrics.py", "harness/test_metrics_oracle.py", "harness/test_page_tables.py",
         "harness/test_sequences.py"),
    ),
    "statistics": (
        ("harness/analysis/comparison.py", "harness/apps/studies/scores.py"),
        ("harness/test_statistics.py", "harness/test_verdict.py", "harness/test_tables.py",
         "harness/test_page_tables.py", "apps/studies/test_scores.py"),
    ),
    "results": (
        ("harness/batch/results.py", "harness/batch/store.py", "harness/batch/tables.py"),
        ("harness/test_results.py", "harness/test_result.py", "harness/test_integrity.py",
         "harness/test_foreign_folders.py"),
    ),
    "folders": (
        ("harness/batch/tables.py", "plant/contract/checksums.py", "harness/batch/integrity.py",
         "harness/batch/results.py", "harness/batch/store.py"),
        ("plant/test_checksums.py", "harness/test_results.py", "harness/test_integrity.py",
         "harness/test_foreign_folders.py"),
    ),
}  # fmt: skip
BROKEN = 77  # exit code of a mutant that could not be put in place
CPU_MARGIN = 3.0  # times the processor time of its tests with their lines noted, after which a mutant counts as found
MIN_CPU = 10  # [s] that a mutant has at least
ANEW_CPU = 30  # [s] more for one that is imported anew
MEMORY = 8 << 30  # [byte] of a mutant
IMPORTED = "ignore::pytest.PytestAssertRewriteWarning"  # hypothesis is there before pytest is
PROFILE = "mutants"  # of hypothesis: the examples of the suite; the first that fails is enough
LEAST = 0.85  # score that is wanted


class Reached(NamedTuple):
    """What a test reaches."""

    lines: set[tuple[str, int]]  # files and numbers
    seconds: float  # of the processor, while lines are noted


class Examination:
    """A plugin of pytest that meets mutants instead of running the collected tests once."""

    def __init__(self, mutants: list[Mutant], arguments: list[str]) -> None:
        self._mutants, self._arguments = mutants, arguments
        self.survivors: list[str] = []
        self.tried = 0
        self.sound = False

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Try every mutant, once the tests pass without one."""
        gc.unfreeze()  # what conftest.py keeps from being found
        imported = Imported()
        gc.freeze()  # so that children copy little; frozen objects are not found any more
        files = {
            str(sys.modules[each.name].__file__)
            for each in self._mutants
            if each.name in sys.modules
        }
        found = [
            answered(partial(self._trace, session, item, imported, files))[0]
            for item in session.items
        ]
        self.sound = bool(found) and None not in found and not session.testsfailed
        for mutant in self._mutants if self.sound else []:
            if not self._fails(session, mutant, imported, found):
                self.survivors.append(str(mutant))
            self.tried += 1
            print(
                f"\r{self.tried} of {len(self._mutants)}, {len(self.survivors)} survived ",
                end="",
                flush=True,
            )
        gc.unfreeze()
        return True

    @staticmethod
    def _trace(
        session: pytest.Session, item: pytest.Item, imported: Imported, files: set[str]
    ) -> Reached | None:
        """Return what a test reaches with its fixtures, of which a fresh process has none; None if it fails."""
        silence()
        imported.clear_caches()
        found = traced(files, lambda: _run(session, [item]))
        return None if session.testsfailed else found

    def _fails(
        self, session: pytest.Session, mutant: Mutant, imported: Imported, found: list[Reached]
    ) -> bool:
        """Return whether one of the tests fails with a mutant: those that reach it, the quickest first, else all."""
        lines = mutant.reach()
        file = str(sys.modules[mutant.name].__file__) if mutant.name in sys.modules else ""
        wanted = {(file, line) for line in lines or ()}
        tests = [
            test for test, reached in enumerate(found) if lines is None or wanted & reached.lines
        ]
        if not tests:
            return False
        tests.sort(key=lambda test: found[test].seconds)
        cost = sum(found[test].seconds for test in tests)
        limit = int(max(MIN_CPU, CPU_MARGIN * cost)) + (ANEW_CPU if lines is None else 0)

        def run() -> None:
            silence()
            resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
            items = [session.items[test] for test in tests]
            try:
                swapped = mutant.swap(imported)
            except LookupError:
                sys.exit(BROKEN)
            if swapped:
                sys.exit(_run(session, items))
            for name in [name for name in sys.modules if name.startswith(ANEW)]:
                del sys.modules[name]
            sys.meta_path.insert(0, Changed(mutant))
            sys.exit(
                int(pytest.main(self._arguments, plugins=[Order([item.nodeid for item in items])]))
            )

        code = ended(run)
        if code == BROKEN:
            raise LookupError(f"the module of {mutant} is not imported by the tests of its group")
        return code != 0


class Order:
    """A plugin of pytest that runs tests in a given order."""

    def __init__(self, names: list[str]) -> None:
        self._places = {name: place for place, name in enumerate(names)}

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        """Sort the tests; new ones come last."""
        items.sort(key=lambda item: self._places.get(item.nodeid, len(self._places)))


def traced(files: set[str], work: Callable[[], object]) -> Reached:
    """Do something, and return which lines of some files it runs."""
    lines = set()

    def note(frame, event, _argument):
        if event == "line":
            lines.add((frame.f_code.co_filename, frame.f_lineno))
        return note

    def enter(frame, _event, _argument):
        return note if frame.f_code.co_filename in files else None

    begin = time.process_time()
    threading.settrace(enter)
    sys.settrace(enter)
    work()
    sys.settrace(None)
    return Reached(lines, time.process_time() - begin)


def silence() -> None:
    """Let nothing that this process writes be seen any more."""
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)


def _run(session: pytest.Session, items: list[pytest.Item]) -> int:
    """Run tests in this process until one fails."""
    for item, following in zip(items, [*items[1:], None], strict=True):
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
        if session.testsfailed:
            return 1
    return 0


def examine(group: str, most: int, seed: int) -> tuple[int, Examination]:
    """Return how many mutants a group has, and what came of a sample of them."""
    patterns, files = GROUPS[group]
    modules = sorted(
        str(path.relative_to(ROOT)) for pattern in patterns for path in ROOT.glob(pattern)
    )
    tests = [str(ROOT / "tests" / name) for name in files]
    if missing := [test for test in tests if not Path(test).exists()]:
        sys.exit(f"the unit tests of {group} are not there: {' '.join(missing)}")
    all_of_them = [mutant for module in modules for mutant in mutants(module)]
    chosen = random.Random(seed).sample(all_of_them, min(most, len(all_of_them)))
    options = [
        "-x",
        "-q",
        "-s",
        "--tb=no",
        "-p",
        "no:cacheprovider",
        f"--hypothesis-profile={PROFILE}",
        "-W",
        IMPORTED,
    ]
    examination = Examination(chosen, [*options, *tests])
    pytest.main([*options, *tests], plugins=[examination])
    if not examination.sound:
        sys.exit(f"the unit tests of {group} fail without any fault: {' '.join(tests)}")
    return len(all_of_them), examination


def main() -> int:
    """Examine groups and write the survivors; exit code 1 if a score is below the one that is wanted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("groups", nargs="*", help=f"of {', '.join(GROUPS)}; all by default")
    parser.add_argument("--most", type=int, default=300, help="mutants of a group")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument(
        "--out", type=Path, default=ROOT / "results" / "mutation", help="folder of the lists"
    )
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    phases = (Phase.explicit, Phase.generate)
    settings.register_profile(
        PROFILE, deadline=None, derandomize=True, phases=phases, report_multiple_bugs=False
    )
    scores = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = (
            folder  # so that no failure of a mutant is tried again later
        )
        for group in asked.groups or GROUPS:
            total, found = examine(group, asked.most, asked.seed)
            dead = found.tried - len(found.survivors)
            scores.append(dead / found.tried)
            line = f"{group}: {dead} of {found.tried} mutants found ({scores[-1]:.1%}), of {total}"
            (asked.out / f"{group}.txt").write_text(
                "\n".join([line, *sorted(found.survivors), ""]), encoding="utf-8"
            )
            print(f"\r{line}")
    return int(min(scores) < LEAST)


if __name__ == "__main__":
    sys.exit(main())
