"""How hard a folder's code is to read, measured a statement, so that no layout changes it.

    python tests/kit/reading.py plant controllers fmus harness

Counted are nodes of the syntax tree, without docstrings and imports. It is a thermometer: whoever splits statements
without sense for its sake makes the code worse.
"""

import ast
import io
import re
import sys
import tokenize
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

SIMPLE = (ast.Assign, ast.AugAssign, ast.AnnAssign, ast.Return, ast.Expr, ast.Raise)
DENSE_STATEMENT = 20  # [nodes]
DENSE_FUNCTION = 16.0  # [nodes a statement]
SHORTEST = 4  # [statements] of a function that is judged by its mean
TRUTHS = (ast.Compare, ast.BoolOp)
TRUTH_FUNCTIONS = ("bool", "any", "all", "isinstance")
SEQUENCES = (ast.List, ast.Tuple, ast.JoinedStr)
NOUNLESS = re.compile(r"#\s*(\[[^\]]*\]\s*)?of\b")


@dataclass
class Reading:
    """What is counted in the files of a folder."""

    statements: list[int] = field(default_factory=list)  # nodes of each
    functions: dict[str, float] = field(default_factory=dict)  # mean nodes a statement, by place
    tuple_assignments: int = 0  # of values that are neither swapped nor unpacked
    conditional_expressions: int = 0
    walruses: int = 0  # outside of conditions
    texts_times_truth: int = 0
    nounless_comments: int = 0  # that begin with "of"
    reasons: int = 0  # comments on lines of their own inside functions
    nodes: int = 0

    @property
    def mean(self) -> float:
        """Mean nodes a statement."""
        return sum(self.statements) / len(self.statements)

    @property
    def dense_statements(self) -> float:
        """Share of the statements above `DENSE_STATEMENT` [%]."""
        dense = sum(each > DENSE_STATEMENT for each in self.statements)
        return 100 * dense / len(self.statements)

    @property
    def dense_functions(self) -> float:
        """Share of the functions whose mean is above `DENSE_FUNCTION` [%]."""
        dense = sum(each > DENSE_FUNCTION for each in self.functions.values())
        return 100 * dense / max(1, len(self.functions))


def read(paths: Iterable[Path]) -> Reading:
    """Return what is counted in some files."""
    reading = Reading()
    for path in paths:
        text = path.read_text(encoding="utf-8")
        tree = ast.parse(text)
        reading.nodes += size(tree)
        _count_forms(reading, tree)
        functions = [
            node
            for node in ast.walk(tree)
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
        ]
        inside = set()
        for function in functions:
            inside.update(range(function.lineno, function.end_lineno + 1))
            sizes = list(statements(function))
            reading.statements += sizes
            if len(sizes) >= SHORTEST:
                place = f"{path}:{function.lineno} {function.name}"
                reading.functions[place] = sum(sizes) / len(sizes)
        _count_comments(reading, text, inside)
    return reading


def is_docstring(node: ast.AST) -> bool:
    """Return whether a statement is nothing but a text."""
    return (
        isinstance(node, ast.Expr)
        and isinstance(node.value, ast.Constant)
        and isinstance(node.value.value, str)
    )


def size(node: ast.AST) -> int:
    """Return the number of nodes below and with one."""
    if is_docstring(node) or isinstance(node, ast.expr_context | ast.Import | ast.ImportFrom):
        return 0
    return 1 + sum(size(child) for child in ast.iter_child_nodes(node))


def statements(function: ast.AST) -> Iterator[int]:
    """Yield the size of each statement of a function, and of the heads of compound ones."""
    for node in ast.walk(function):
        if isinstance(node, SIMPLE) and not is_docstring(node):
            yield size(node)
        elif isinstance(node, ast.If | ast.While):
            yield 1 + size(node.test)
        elif isinstance(node, ast.For):
            yield 1 + size(node.target) + size(node.iter)
        elif isinstance(node, ast.With):
            yield 1 + sum(size(item) for item in node.items)


def _count_forms(reading: Reading, tree: ast.AST) -> None:
    conditions = _walruses_in_conditions(tree)
    for node in ast.walk(tree):
        if isinstance(node, ast.Assign):
            reading.tuple_assignments += _is_crammed(node)
        elif isinstance(node, ast.IfExp):
            reading.conditional_expressions += 1
        elif isinstance(node, ast.NamedExpr):
            reading.walruses += id(node) not in conditions
        elif isinstance(node, ast.BinOp) and isinstance(node.op, ast.Mult):
            one = _is_sequence(node.left) and _is_truth(node.right)
            other = _is_sequence(node.right) and _is_truth(node.left)
            reading.texts_times_truth += one or other


def _walruses_in_conditions(tree: ast.AST) -> set[int]:
    """Return the identities of the assignment expressions that stand in a condition."""
    tests = []
    for node in ast.walk(tree):
        if isinstance(node, ast.If | ast.While):
            tests.append(node.test)
        elif isinstance(node, ast.comprehension):
            tests += node.ifs
    found = set()
    for test in tests:
        found.update(id(each) for each in ast.walk(test) if isinstance(each, ast.NamedExpr))
    return found


def _is_crammed(node: ast.Assign) -> bool:
    """Return whether several values are assigned to several names without a swap."""
    if not isinstance(node.value, ast.Tuple):
        return False
    targets = [each for each in node.targets if isinstance(each, ast.Tuple)]
    assigned = {name for each in targets for name in _names(each)}
    return bool(targets) and not assigned & _names(node.value)


def _names(node: ast.AST) -> set[str]:
    return {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}


def _is_truth(node: ast.AST) -> bool:
    if isinstance(node, ast.Call):
        return isinstance(node.func, ast.Name) and node.func.id in TRUTH_FUNCTIONS
    if isinstance(node, ast.UnaryOp):
        return isinstance(node.op, ast.Not)
    return isinstance(node, TRUTHS)


def _is_sequence(node: ast.AST) -> bool:
    if isinstance(node, ast.Constant):
        return isinstance(node.value, str)
    return isinstance(node, SEQUENCES)


def _count_comments(reading: Reading, text: str, inside: set[int]) -> None:
    """Count comments; `inside` are the numbers of the lines of functions."""
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type != tokenize.COMMENT:
            continue
        alone = token.line.lstrip().startswith("#")
        reading.nounless_comments += bool(NOUNLESS.match(token.string))
        reading.reasons += alone and token.start[0] in inside


def main() -> None:
    """Print the figures of the folders that are named, and their densest functions."""
    reading = read(path for folder in sys.argv[1:] for path in sorted(Path(folder).rglob("*.py")))
    print(f"mean nodes a statement     {reading.mean:.1f}")
    print(f"dense statements [%]       {reading.dense_statements:.1f}")
    print(f"dense functions [%]        {reading.dense_functions:.1f}")
    print(f"tuple assignments          {reading.tuple_assignments}")
    print(f"conditional expressions    {reading.conditional_expressions}")
    print(f"walruses beside conditions {reading.walruses}")
    print(f"texts times truth          {reading.texts_times_truth}")
    print(f"comments without a noun    {reading.nounless_comments}")
    print(f"comments inside functions  {reading.reasons}")
    print(f"nodes                      {reading.nodes}")
    for place, mean in sorted(reading.functions.items(), key=lambda each: -each[1])[:20]:
        print(f"{mean:6.1f}  {place}")


if __name__ == "__main__":
    main()
