"""Small faults in a module, each of which can be put into the imported module of a process.

A mutant is a module with one fault: another operator, a bound one further, a negated condition, another constant,
minimum for maximum, a call left out (the operators that Offutt et al. found sufficient, "An experimental determination
of sufficient mutant operators", 1996, and four of numerical code).
"""

from __future__ import annotations

import ast
import copy
import functools
import gc
import importlib.machinery
import importlib.util
import sys
import types
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
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
ANEW = ("servobench", "kit", "test_")  # how the names of modules begin that may see a changed one


@dataclass(frozen=True)
class Mutant:
    """A module with one fault."""

    module: str  # its path
    place: int  # of the changed node in the order of `ast.walk`
    choice: int  # among what the node may become

    def tree(self) -> ast.Module:
        """Return the changed module."""
        tree, node, changed = self._find()
        return ast.fix_missing_locations(_Replacing(node, changed).visit(tree))

    def _find(self) -> tuple[ast.Module, ast.AST, ast.AST]:
        """Return the tree of the module, the node with the fault, and the node that takes its place."""
        tree = _parse(self.module)
        node = list(ast.walk(tree))[self.place]
        return tree, node, list(changes(node))[self.choice]

    def __str__(self) -> str:
        """Return the line, and what was changed in it."""
        _, node, changed = self._find()
        line = (
            (ROOT / self.module).read_text(encoding="utf-8").splitlines()[node.lineno - 1].strip()
        )
        before, after = (ast.unparse(each).splitlines()[0] for each in (node, changed))
        return f"{self.module}:{node.lineno}:{node.col_offset + 1}: {before}  ->  {after}    in: {line}"

    @property
    def name(self) -> str:
        """Name of the module where it is imported."""
        return "servobench." + self.module.removesuffix(".py").replace("/", ".")

    def swap(self, imported: Imported) -> bool:
        """Give the functions of the imported module the changed code; False if the fault is outside of functions."""
        if self.name not in sys.modules or self.reach() is None:
            return False
        file = str(sys.modules[self.name].__file__)
        changed = {_key(code): code for code in _codes(compile(self.tree(), file, "exec"))}
        if not imported.functions[file]:
            raise LookupError(f"no function of {file} is imported")
        for each in imported.functions[file]:
            each.__code__ = changed[_key(each.__code__)]
        imported.clear_caches()
        return True

    def reach(self) -> range | None:
        """Return the lines of which one runs whenever the fault has an effect; None if it is outside of functions.

        They are those of the statement with the fault, without the statements that stand in its body.
        """
        tree, node, _ = self._find()
        holding = [
            each for each in ast.walk(tree) if isinstance(each, ast.stmt) and node in ast.walk(each)
        ]
        if not any(
            part in each.body
            for each in holding
            if isinstance(each, ast.FunctionDef)
            for part in holding
        ):
            return None
        inner = holding[-1]
        below = [
            each.lineno
            for each in ast.walk(inner)
            if isinstance(each, ast.stmt) and each is not inner
        ]
        return range(inner.lineno, min(below, default=inner.end_lineno + 1))


class Imported:
    """The functions and the caches of all modules that are imported, by file and once for all mutants."""

    def __init__(self) -> None:
        self.functions: dict[str, list[types.FunctionType]] = defaultdict(list)
        self._caches: list[functools._lru_cache_wrapper[object]] = []
        for each in gc.get_objects():
            if isinstance(each, types.FunctionType):
                self.functions[each.__code__.co_filename].append(each)
            elif isinstance(each, functools._lru_cache_wrapper) and str(each.__module__).startswith(
                ANEW
            ):
                self._caches.append(each)

    def clear_caches(self) -> None:
        """Forget what functions of the package and of its tests have kept."""
        for each in self._caches:
            each.cache_clear()


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
        case ast.If(test=test) | ast.IfExp(test=test) if not isinstance(
            test, ast.Compare | ast.BoolOp | ast.UnaryOp
        ):
            yield _with(node, test=ast.UnaryOp(ast.Not(), test))
        case ast.Expr(value=ast.Call()) | ast.AugAssign():
            yield ast.Pass()


def mutants(module: str) -> list[Mutant]:
    """Return all mutants of a module; texts, annotations and decorators stay as they are."""
    tree = _parse(module)
    kept = {
        id(below) for node in ast.walk(tree) for part in _not_code(node) for below in ast.walk(part)
    }
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
    """Return the tree of a module, a new one each time, as mutants change theirs."""
    return ast.parse((ROOT / module).read_text(encoding="utf-8"))


def _with(node: ast.AST, **values: object) -> ast.AST:
    changed = copy.copy(node)
    for name, value in values.items():
        setattr(changed, name, value)
    return changed


class _Replacing(ast.NodeTransformer):
    """Puts a node in the place of another one."""

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self._old, self._new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self._new if node is self._old else self.generic_visit(node)


class Changed(importlib.machinery.SourceFileLoader):
    """Finds one module, and imports it from a changed tree."""

    def __init__(self, mutant: Mutant) -> None:
        super().__init__(mutant.name, str(ROOT / mutant.module))
        self._code = compile(mutant.tree(), self.path, "exec")

    def find_spec(self, fullname, path=None, target=None):
        return (
            importlib.util.spec_from_file_location(fullname, loader=self)
            if fullname == self.name
            else None
        )

    def get_code(self, fullname):
        return self._code
