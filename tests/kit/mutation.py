"""Mutation testing: whether the unit tests of a module notice small faults in it; `python tests/kit/mutation.py`.

A mutant is a module with one fault: another operator, a bound one further, a negated condition, another constant,
minimum for maximum, a call left out (the operators that Offutt et al. found sufficient, "An experimental determination
of sufficient mutant operators", 1996, and four of numerical code). A seeded sample of the mutants of each group of
modules meets the group's unit tests; the score is the share that fails them. What survives is listed, with its line.

Nothing on disk is changed. The tests are collected once; each mutant is a forked process in which the functions of the
module get the changed code, or, where the fault is outside of functions, in which everything is imported anew from the
changed tree. So a mutant costs no more than the tests that it fails. That is why no tool of the trade is used here:
cosmic-ray writes the mutants into the working tree and starts an interpreter for each, which costs more than most of
these tests; mutmut finds modules by their paths, and the links in `.package` give them other names.
"""

from __future__ import annotations

import argparse
import ast
import copy
import functools
import gc
import importlib.abc
import importlib.util
import os
import random
import resource
import sys
import tempfile
import types
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
GROUPS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {  # name -> modules, unit tests
    "kinematics": (
        ("plant/robot/arm.py", "plant/robot/hand_eye.py"),
        ("plant/test_arm.py", "plant/test_symbolic.py", "plant/test_plant_lanes.py"),
    ),
    "estimators": (
        ("controllers/estimators/*.py",),
        ("controllers/test_estimators.py", "controllers/test_arm_estimator.py", "controllers/test_rbf.py",
         "controllers/test_rbf_lyapunov.py", "controllers/test_estimator_lanes.py",
         "controllers/test_correntropy.py", "controllers/test_robust.py"),
    ),
    "laws": (
        ("controllers/laws/*.py", "controllers/laws/mpc/*.py"),
        ("controllers/test_pid.py", "controllers/test_mfac.py", "controllers/test_laws.py",
         "controllers/test_preview.py", "controllers/test_rbfnn.py", "controllers/test_mpc.py",
         "controllers/test_mpc_closed_form.py", "controllers/test_mpc_optimality.py"),
    ),
    "metrics": (("harness/run/metrics.py",), ("harness/test_metrics.py", "harness/test_metrics_oracle.py")),
    "statistics": (("harness/analysis/statistics.py",), ("harness/test_statistics.py",)),
    "results": (("harness/batch/results.py",), ("harness/test_results.py", "harness/test_ending.py")),
    "folders": (
        ("harness/batch/parquet.py", "harness/batch/checksums.py", "harness/batch/integrity.py",
         "harness/batch/manifest_text.py"),
        ("harness/test_results.py", "harness/test_integrity.py"),
    ),
}  # fmt: skip
BINARY: dict[type[ast.operator], type[ast.operator]] = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult, ast.Pow: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd,
}  # fmt: skip
COMPARISONS: dict[type[ast.cmpop], tuple[type[ast.cmpop], ...]] = {
    ast.Lt: (ast.LtE, ast.GtE), ast.LtE: (ast.Lt, ast.Gt), ast.Gt: (ast.GtE, ast.LtE), ast.GtE: (ast.Gt, ast.Lt),
    ast.Eq: (ast.NotEq,), ast.NotEq: (ast.Eq,), ast.In: (ast.NotIn,), ast.NotIn: (ast.In,),
    ast.Is: (ast.IsNot,), ast.IsNot: (ast.Is,),
}  # fmt: skip
PAIRS = (("maximum", "minimum"), ("max", "min"), ("argmax", "argmin"), ("any", "all"), ("sin", "cos"),
         ("ceil", "floor"))  # fmt: skip
NAMES = {a: b for pair in PAIRS for a, b in (pair, pair[::-1])}
BROKEN = 77  # exit code of a mutant that could not be put in place
CPU_MARGIN = 5.0  # times the processor time of the tests without a fault, after which a mutant counts as found
MIN_CPU = 20  # [s] that a mutant has at least
MEMORY = 8 << 30  # [byte] of a mutant
IMPORTED = "ignore::pytest.PytestAssertRewriteWarning"  # hypothesis is there before pytest is
ANEW = ("servobench", "kit")  # packages that see the changed module
LEAST = 0.85  # score that is wanted


@dataclass(frozen=True)
class Mutant:
    """A module with one fault."""

    module: str  # its path
    place: int  # of the changed node in the order of `ast.walk`
    choice: int  # among what the node may become

    def tree(self) -> ast.Module:
        """Return the changed module."""
        tree = _parse(self.module)
        node = list(ast.walk(tree))[self.place]
        _replace(tree, node, list(changes(node))[self.choice])
        return ast.fix_missing_locations(tree)

    def __str__(self) -> str:
        """Return the line, and what was changed in it."""
        tree = _parse(self.module)
        node = list(ast.walk(tree))[self.place]
        line = (ROOT / self.module).read_text(encoding="utf-8").splitlines()[node.lineno - 1].strip()
        before, after = (ast.unparse(each).splitlines()[0] for each in (node, list(changes(node))[self.choice]))
        return f"{self.module}:{node.lineno}:{node.col_offset + 1}: {before}  ->  {after}    in: {line}"

    @property
    def name(self) -> str:
        """Name of the module where it is imported."""
        return "servobench." + self.module.removesuffix(".py").replace("/", ".")

    def swap(self) -> bool:
        """Give the functions of the imported module the changed code; False if the fault is outside of functions."""
        tree = _parse(self.module)
        node = list(ast.walk(tree))[self.place]
        bodies = [part for each in ast.walk(tree) if isinstance(each, ast.FunctionDef) for part in each.body]
        if self.name not in sys.modules or not any(below is node for part in bodies for below in ast.walk(part)):
            return False
        file = str(sys.modules[self.name].__file__)
        changed = {_key(code): code for code in _codes(compile(self.tree(), file, "exec"))}
        functions = [each for each in gc.get_objects() if _is_function_of(each, file)]
        if not functions:
            raise LookupError(f"no function of {file} is imported")
        for each in functions:
            each.__code__ = changed[_key(each.__code__)]
        for each in gc.get_objects():
            if isinstance(each, functools._lru_cache_wrapper) and each.__module__.startswith("servobench."):
                each.cache_clear()
        return True


def _is_function_of(each: object, file: str) -> bool:
    return isinstance(each, types.FunctionType) and each.__code__.co_filename == file


def _key(code: types.CodeType) -> tuple[str, int]:
    return code.co_qualname, code.co_firstlineno


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Yield all code below a module."""
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield constant
            yield from _codes(constant)


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yield what a node may become."""
    match node:
        case ast.BinOp(op=op) if type(op) in BINARY:
            yield _with(node, op=BINARY[type(op)]())
        case ast.Compare(ops=[op, *others]):
            for other in COMPARISONS[type(op)]:
                yield _with(node, ops=[other(), *others])
        case ast.BoolOp(op=op):
            yield _with(node, op=ast.Or() if isinstance(op, ast.And) else ast.And())
        case ast.UnaryOp(op=ast.Not() | ast.USub() | ast.Invert(), operand=operand):
            yield operand
        case ast.Constant(value=bool(value)):
            yield ast.Constant(not value)
        case ast.Constant(value=int(value)):
            yield ast.Constant(value + 1)
        case ast.Constant(value=float(value)):
            yield ast.Constant(2.0 * value if value else 1.0)
        case ast.Attribute(attr=name) | ast.Name(id=name) if name in NAMES:
            yield _with(node, **{"attr" if isinstance(node, ast.Attribute) else "id": NAMES[name]})
        case ast.If(test=test) | ast.IfExp(test=test) if not isinstance(test, ast.Compare | ast.BoolOp | ast.UnaryOp):
            yield _with(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Expr(value=ast.Call()) | ast.AugAssign():
            yield ast.Pass()


def mutants(module: str) -> list[Mutant]:
    """Return all mutants of a module; texts, annotations and decorators stay as they are."""
    tree = _parse(module)
    kept = {id(below) for node in ast.walk(tree) for part in _not_code(node) for below in ast.walk(part)}
    return [
        Mutant(module, place, choice)
        for place, node in enumerate(ast.walk(tree))
        if id(node) not in kept
        for choice, _ in enumerate(changes(node))
    ]


def _not_code(node: ast.AST) -> Iterator[ast.AST]:
    """Yield the parts of a node that are read by people and type checkers only: annotations, decorators, messages."""
    match node:
        case ast.FunctionDef():
            yield from [*node.decorator_list, *([node.returns] if node.returns else [])]
        case ast.ClassDef():
            yield from node.decorator_list
        case ast.arg(annotation=ast.AST() as annotation):
            yield annotation
        case ast.AnnAssign():
            yield node.annotation
        case ast.Raise(exc=ast.Call() as error):
            yield from error.args
        case ast.If(test=ast.Name(id="TYPE_CHECKING")):
            yield node


def _parse(module: str) -> ast.Module:
    return ast.parse((ROOT / module).read_text(encoding="utf-8"))


def _with(node: ast.AST, **values: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in values.items():
        setattr(changed, name, value)
    return changed


def _replace(tree: ast.AST, old: ast.AST, new: ast.AST) -> None:
    for node in ast.walk(tree):
        for name, value in ast.iter_fields(node):
            if value is old:
                setattr(node, name, new)
            elif isinstance(value, list):
                value[:] = [new if each is old else each for each in value]


class Changed(importlib.abc.MetaPathFinder, importlib.abc.SourceLoader):
    """Imports one module from a changed tree."""

    def __init__(self, mutant: Mutant) -> None:
        self._path, self._tree, self._name = ROOT / mutant.module, mutant.tree(), mutant.name

    def find_spec(self, fullname, path=None, target=None):
        if fullname != self._name:
            return None
        return importlib.util.spec_from_file_location(fullname, self._path, loader=self)

    def get_code(self, fullname):
        return compile(self._tree, str(self._path), "exec")

    def get_filename(self, fullname):
        return str(self._path)

    def get_data(self, path):
        return Path(path).read_bytes()


class Examination:
    """A plugin of pytest that meets mutants instead of running the collected tests once."""

    def __init__(self, mutants: list[Mutant], arguments: list[str]) -> None:
        self._mutants, self._arguments = mutants, arguments
        self.survivors: list[str] = []
        self.tried = 0
        self.sound = False

    def pytest_runtestloop(self, session):
        """Try every mutant, once the tests pass without one."""
        failed, cpu = self._fails(session, None, 60.0)
        self.sound = bool(session.items) and not session.testsfailed and not failed
        for mutant in self._mutants if self.sound else []:
            if not self._fails(session, mutant, cpu)[0]:
                self.survivors.append(str(mutant))
            self.tried += 1
            print(f"\r{self.tried} of {len(self._mutants)}, {len(self.survivors)} survived ", end="", flush=True)
        return True

    def _fails(self, session, mutant: Mutant | None, cpu: float) -> tuple[bool, float]:
        """Return whether the tests fail with a mutant, or without one, and their processor time [s]."""
        child = os.fork()
        if child == 0:
            code = 1
            try:
                limit = int(max(MIN_CPU, CPU_MARGIN * cpu))
                resource.setrlimit(resource.RLIMIT_CPU, (limit, limit))
                resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
                _silence()
                code = self._run(session, mutant)
            except LookupError:
                code = BROKEN
            finally:
                os._exit(int(code))
        _, status, used = os.wait4(child, 0)
        if os.WIFEXITED(status) and os.WEXITSTATUS(status) == BROKEN:
            raise LookupError(f"the module of {mutant} is not imported by the tests of its group")
        return status != 0, used.ru_utime + used.ru_stime

    def _run(self, session, mutant: Mutant | None) -> int:
        """Run the tests in this process until one fails."""
        if mutant is not None and not mutant.swap():
            for name in [name for name in sys.modules if name.partition(".")[0] in ANEW or name.startswith("test_")]:
                del sys.modules[name]
            sys.meta_path.insert(0, Changed(mutant))
            return int(pytest.main(self._arguments))
        for item, following in zip(session.items, [*session.items[1:], None], strict=True):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if session.testsfailed:
                return 1
        return 0


def _silence() -> None:
    nothing = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        os.dup2(nothing, stream)


def examine(group: str, most: int, seed: int) -> tuple[int, Examination]:
    """Return how many mutants a group has, and what came of a sample of them."""
    patterns, files = GROUPS[group]
    modules = sorted(str(path.relative_to(ROOT)) for pattern in patterns for path in ROOT.glob(pattern))
    tests = [str(ROOT / "tests" / name) for name in files]
    all_of_them = [mutant for module in modules for mutant in mutants(module)]
    chosen = random.Random(seed).sample(all_of_them, min(most, len(all_of_them)))
    arguments = ["-x", "-q", "-s", "-p", "no:cacheprovider", "--hypothesis-seed=0", "-W", IMPORTED, *tests]
    examination = Examination(chosen, arguments)
    pytest.main(arguments, plugins=[examination])
    if not examination.sound:
        sys.exit(f"the unit tests of {group} fail without any fault: {' '.join(tests)}")
    return len(all_of_them), examination


def main() -> int:
    """Examine groups and write the survivors; exit code 1 if a score is below the one that is wanted."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("groups", nargs="*", help=f"of {', '.join(GROUPS)}; all by default")
    parser.add_argument("--most", type=int, default=300, help="mutants of a group")
    parser.add_argument("--seed", type=int, default=0, help="of the sample")
    parser.add_argument("--out", type=Path, default=ROOT / "results" / "mutation", help="folder of the lists")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    os.chdir(ROOT)
    scores = []
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = folder  # so that no failure of a mutant is tried again later
        for group in asked.groups or GROUPS:
            total, found = examine(group, asked.most, asked.seed)
            dead = found.tried - len(found.survivors)
            scores.append(dead / found.tried)
            line = f"{group}: {dead} of {found.tried} mutants found ({scores[-1]:.1%}), of {total}"
            (asked.out / f"{group}.txt").write_text("\n".join([line, *sorted(found.survivors), ""]), encoding="utf-8")
            print(f"\r{line}")
    return int(min(scores) < LEAST)


if __name__ == "__main__":
    sys.exit(main())
