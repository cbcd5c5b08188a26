"""A system in discrete time as CasADi functions, recorded from a pure step of numpy code."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from servobench.fmus.trace.array import Expression, NotTraceable, Traced, as_traced
from servobench.fmus.trace.branches import leaves_of, symbols_like, with_leaves
from servobench.fmus.trace.faults import frame
from servobench.fmus.trace.namespace import recording

Inputs = Mapping[str, Any]


@dataclass(frozen=True)
class Recorded:
    """A system x(0) = start(u), (x, y) ← step(x, u).

    Attributes:
        start: CasADi function u -> x, code.
        step: CasADi function x, u -> x, y, code; a code that is not 0 is one of `faults.MESSAGES`.
    """

    start: Any
    step: Any

    @property
    def states(self) -> int:
        """Number of entries of the state."""
        return int(self.start.numel_out(0))


def record(
    system: Any,  # noqa: ANN401 - whatever the functions need
    start: Callable[[Any, Inputs], Any],
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Mapping[str, tuple[tuple[int, ...], str]],
) -> Recorded:
    """Record a system.

    Args:
        system: what both functions get first; a copy of it is used, whose memos may keep expressions.
        start: system, inputs -> state, a tree of arrays.
        step: system, state, inputs -> new state of the same form, and the output.
        inputs: shape and kind of each, in the order of the columns of u.

    Raises:
        NotTraceable: it cannot be recorded; names the function that stands in the way.
    """
    try:
        own = deepcopy(system)
    except TypeError as error:
        raise NotTraceable("it holds something that is no formula, such as a solver") from error
    try:
        with recording():
            first, begin = _recorded_start(own, start, inputs)
            advance = _recorded_step(own, step, inputs, first)
    except NotTraceable as error:
        raise NotTraceable(f"{_place(error)}: {error}") from error
    except RuntimeError as error:  # of CasADi
        said = str(error).partition("\n")[0]
        raise NotTraceable(f"{_place(error)}: CasADi cannot express it ({said})") from error
    return Recorded(begin, advance)


def _recorded_start(
    system: Any,  # noqa: ANN401 - as `record`
    start: Callable[[Any, Inputs], Any],
    inputs: Mapping[str, tuple[tuple[int, ...], str]],
) -> tuple[Any, Any]:
    """Return the state at the start and the function that computes it."""
    values, u = _inputs(inputs)
    with frame() as faults:
        tree = start(system, values)
    column = casadi.vertcat(*map(_column, leaves_of(tree)))
    return tree, casadi.Function("controller_start", [u], [column, faults.code], {"cse": True})


def _recorded_step(
    system: Any,  # noqa: ANN401 - as `record`
    step: Callable[[Any, Any, Inputs], tuple[Any, Any]],
    inputs: Mapping[str, tuple[tuple[int, ...], str]],
    first: Any,  # noqa: ANN401 - any tree
) -> Any:  # noqa: ANN401 - a function of CasADi
    """Return the function that computes a step from a state like the `first`."""
    values, u = _inputs(inputs)
    leaves = leaves_of(first)
    symbols = symbols_like(leaves)
    with frame() as faults:
        state, output = step(system, with_leaves(first, symbols), values)
    new = leaves_of(state)
    if [np.shape(leaf) for leaf in new] != [np.shape(leaf) for leaf in leaves]:
        raise NotTraceable("its state has other sizes later than at the start")
    x = casadi.MX.sym("x", sum(symbol.size for symbol in symbols))
    parts = casadi.vertsplit(x, np.cumsum([0, *(symbol.size for symbol in symbols)]).tolist())
    results = [casadi.vertcat(*map(_column, new)), as_traced(output).flat(), faults.code]
    results = casadi.substitute(results, [symbol.buffer.content for symbol in symbols], parts)
    return casadi.Function("controller_step", [x, u], results, {"cse": True})


def _inputs(inputs: Mapping[str, tuple[tuple[int, ...], str]]) -> tuple[dict[str, Traced], Expression]:
    sizes = [int(np.prod(shape)) for shape, _ in inputs.values()]
    u = casadi.MX.sym("u", sum(sizes))
    ends = np.cumsum([0, *sizes])
    values = {}
    for (name, (shape, kind)), begin in zip(inputs.items(), ends, strict=False):
        part = u[int(begin) : int(begin) + int(np.prod(shape))]
        values[name] = Traced.of(part != 0.0 if kind == "b" else part, shape, kind)
    return values, u


def _column(leaf: Any) -> Expression:  # noqa: ANN401 - an array
    return as_traced(leaf).flat()


def _place(error: BaseException) -> str:
    """Return the innermost function outside of the recorder that an error came through."""
    found, trace = "the code", error.__traceback__
    own = Path(__file__).parent
    while trace is not None:
        code = trace.tb_frame.f_code
        if Path(code.co_filename).parent != own and "servobench" in str(trace.tb_frame.f_globals.get("__name__", "")):
            found = f"{code.co_qualname} in {inspect.getmodulename(code.co_filename)}"
        trace = trace.tb_next
    return found
