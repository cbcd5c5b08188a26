"""Arrays whose numbers are those of a program, in the place of numpy's, and numpy's ufuncs over them.

An array is a table of places in a buffer, which is a node of a program. Numpy changes the order and the shape of the
table as it would those of the array, so that views, slices and broadcasting are numpy's own; writing to a view changes
the buffer that it shares. A buffer holds plain numbers until others are written to it, and such an array can be
used wherever numpy wants numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

from servobench.fmus.controllers.program import (
    CALL,
    JOIN,
    MAP,
    PUT,
    REDUCE,
    Node,
    Operand,
    Places,
    computed,
    numbers,
    operand,
)
from servobench.plant.contract.checks import AnyArray, Shape
from servobench.plant.contract.facts import read_beside

DTYPES = {"b": np.dtype(np.bool_), "i": np.dtype(np.int_), "f": np.dtype(np.float64)}


class NotTraceable(ValueError):
    """Code cannot be recorded: it decides by a number of the run, or calls a function that has no exported form."""


@dataclass(eq=False)
class Buffer:
    """Numbers, plain ones or those of a program, which arrays share."""

    content: Any  # (N,) numbers, or a `Node` of N entries


@dataclass(eq=False)
class Traced(NDArrayOperatorsMixin):
    """An array whose numbers a program computes, or plain ones."""

    buffer: Buffer  # holds its numbers
    places: Places  # positions of its entries in the buffer
    kind: str = "f"  # kind of its numbers, as numpy's: "b", "i" or "f"
    function: ClassVar[Callable[..., Any]]
    """Carries out a function of numpy that is no ufunc; `servobench.fmus.controllers.record` sets it."""
    flags: ClassVar[SimpleNamespace] = SimpleNamespace(writeable=True)

    @classmethod
    def of(cls, node: Node, shape: Shape, kind: str = "f") -> Traced:
        """Return the array (shape) of a node, in row-major order."""
        return cls(Buffer(node), np.arange(node.size).reshape(shape), kind)

    @classmethod
    def plain(cls, numbers: AnyArray) -> Traced:
        """Return an array of numbers to which those of a program can be written."""
        kind = numbers.dtype.kind if numbers.dtype.kind in DTYPES else "f"
        buffer = Buffer(np.array(numbers, dtype=np.float64).reshape(-1))
        return cls(buffer, np.arange(numbers.size).reshape(numbers.shape), kind)

    @property
    def constant(self) -> bool:
        """Whether its entries are plain numbers."""
        return isinstance(self.buffer.content, np.ndarray)

    def numbers(self) -> AnyArray:
        """Return the numbers of a constant array.

        Raises:
            NotTraceable: a program computes them.
        """
        if not self.constant:
            raise NotTraceable("it decides by a number that is known in the run only")
        values: AnyArray = self.buffer.content[self.places]
        return values.astype(DTYPES[self.kind])

    def operand(self, shape: Shape | None = None) -> Operand:
        """Return its entries, or those of a shape to which they are broadcast, as an operand."""
        node = self.buffer.content
        if self.constant:
            node = numbers(node)
        places = self.places
        if shape is not None:
            places = np.broadcast_to(places, shape)
        return operand(node, places)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:  # noqa: ANN401
        """Carry out a ufunc, or a reduction by one, with at least one traced array.

        Raises:
            NotTraceable: it has no exported form.
        """
        outputs = options.pop("out", None)
        options.pop("dtype", None)
        if all(not isinstance(each, Traced) or each.constant for each in inputs):
            numbers = [as_numbers(each) for each in inputs]
            plain_options = _plain_options(options, outputs)
            result = getattr(ufunc, method)(*numbers, **plain_options)
        elif method == "__call__":
            result = _called(ufunc, inputs, options, outputs)
        elif method == "reduce":
            result = reduced(ufunc.__name__, inputs[0], **options)
        else:
            raise NotTraceable(
                f"it calls numpy.{ufunc.__name__}.{method}, which has no exported form"
            )
        if outputs is None:
            return result
        if not isinstance(outputs[0], Traced):
            raise NotTraceable(f"numpy.{ufunc.__name__} writes to an array of numbers")
        outputs[0][...] = result
        return outputs[0]

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:  # noqa: ANN401
        """Carry out another function."""
        del types
        return Traced.function(function, arguments, options)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> AnyArray:  # noqa: ANN401
        """Return the numbers of a constant array."""
        del copy
        return np.asarray(self.numbers(), dtype=dtype)

    def __bool__(self) -> bool:
        """Return the truth of a constant array of one entry."""
        return bool(self.numbers())

    def __int__(self) -> int:
        """Return a constant."""
        return int(self.numbers())

    __index__ = __int__

    def __float__(self) -> float:
        """Return a constant."""
        return float(self.numbers())

    def __len__(self) -> int:
        """Return the size of the first axis."""
        return len(self.places)

    def __iter__(self) -> Iterator[Traced]:
        """Yield the entries of the first axis."""
        return (self[i] for i in range(len(self)))

    def __getitem__(self, key: Any) -> Traced:  # noqa: ANN401 - any index
        """Return a view, or a copy of the entries that a traced index names along the first axis."""
        if not isinstance(key, Traced):
            return self.arranged(self.places[as_numbers(key)])
        if key.constant or key.kind == "b":
            return self[key.numbers()]
        return picked(self, key)

    def __setitem__(self, key: Any, value: Any) -> None:  # noqa: ANN401 - any index, any array
        """Write to the buffer."""
        places = np.asarray(self.places[as_numbers(key)])
        if self.constant and (not isinstance(value, Traced) or value.constant):
            self.buffer.content = self.buffer.content.copy()
            self.buffer.content[places] = as_numbers(value)
        else:
            whole = np.arange(self.entries)
            values = as_traced(value).operand(places.shape)
            if np.array_equal(places.reshape(-1), whole):
                self.buffer.content = computed(JOIN, [values], whole.shape, ())
            else:
                before = Traced(self.buffer, whole).operand()
                targets = tuple(places.reshape(-1).tolist())
                self.buffer.content = computed(PUT, (before, values), whole.shape, targets)

    def arranged(self, places: Places) -> Traced:
        """Return a view with another table of places."""
        return Traced(self.buffer, np.asarray(places), self.kind)

    def copy(self) -> Traced:
        """Return a copy with a buffer of its own."""
        if self.constant:
            return Traced.plain(self.numbers())
        node = computed(JOIN, [self.operand()], (self.size,), ())
        return Traced.of(node, self.shape, self.kind)

    def astype(self, dtype: npt.DTypeLike) -> Traced:
        """Return the numbers as another type; numbers are truncated to whole ones."""
        kind = np.dtype(dtype).kind
        if kind == "i" and self.kind == "f":
            cut: Traced = np.where(self < 0.0, np.ceil(self), np.floor(self))  # type: ignore[assignment]
            return Traced(cut.buffer, cut.places, "i")
        if kind == "b" and self.kind != "b":
            return self != 0.0
        return Traced(self.buffer, self.places, kind)

    def setflags(self, **flags: bool) -> None:
        """Do nothing: traced arrays are always writeable."""

    def tobytes(self) -> bytes:
        """Return bytes that equal those of no other array, so that a memo of it is never used for another one."""
        return b"traced %d %d" % (id(self), next(_COUNTER))

    @property
    def entries(self) -> int:
        """Number of entries of its buffer."""
        return int(self.buffer.content.size)

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its numbers, as numpy's."""
        return DTYPES[self.kind]

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - an attribute of numpy's arrays
        """Return an attribute of numpy's arrays: of the table of places, or a method that is a function as well."""
        if name in SIZES:
            return getattr(self.places, name)
        if name in TRANSPOSES:
            return self.arranged(getattr(self.places, name))
        if name in VIEWS:
            return lambda *arguments: self.arranged(getattr(self.places, name)(*arguments))
        if name in METHODS:
            return partial(getattr(np, name), self)
        raise AttributeError(f"Traced has no attribute {name!r}")


_COUNTER = count()
# Attributes of numpy's arrays that hold for the table of places as well.
SIZES = {"shape", "ndim", "size"}
TRANSPOSES = {"T", "mT"}
VIEWS = {"reshape", "swapaxes"}
METHODS = {
    "sum", "mean", "max", "min", "any", "all", "argmin", "argmax", "cumsum", "trace", "diagonal", "take", "dot",
    "repeat", "ravel", "squeeze", "transpose", "clip",
}  # fmt: skip


def as_numbers(value: Any) -> Any:  # noqa: ANN401 - an array, or lists and tuples with arrays in them
    """Return a value with plain numbers in the place of its constant arrays."""
    if type(value) in {list, tuple}:
        return type(value)(map(as_numbers, value))
    if isinstance(value, Traced):
        return value.numbers()
    return value


def spread(array: Traced, shape: Shape) -> Traced:
    """Return an array broadcast to a shape."""
    return array.arranged(np.broadcast_to(array.places, shape))


def as_traced(value: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return anything array-like as a traced array."""
    if isinstance(value, Traced):
        return value
    return Traced.plain(np.asarray(value))


def picked(array: Any, index: Traced) -> Traced:  # noqa: ANN401 - any array
    """Return the entries that an index (†), known in the run only, names along the first axis, (†, *)."""
    table = as_traced(array)
    rest = table.shape[1:]
    width = int(np.prod(rest))
    sizes = (index.size, width)
    node = computed(
        CALL, (table.operand(), index.operand()), (index.size * width,), ("pick", *sizes)
    )
    return Traced.of(node, (*index.shape, *rest), table.kind)


def joined(arrays: Sequence[Any], arrange: Callable[[list[Places]], Places]) -> Traced:
    """Return arrays as one: `arrange` puts the tables of their places together as numpy would the arrays."""
    parts = [as_traced(array) for array in arrays]
    tables = []
    first = 0
    for part in parts:
        tables.append(first + np.arange(part.size).reshape(part.shape))
        first += part.size
    kind = max((part.kind for part in parts), key="bif".index)
    operands = [part.operand() for part in parts]
    arranged = arrange(tables)
    if arranged.size != first:
        return Traced(Buffer(computed(JOIN, operands, (first,), ())), arranged, kind)
    order = arranged.reshape(-1)
    detail = () if np.array_equal(order, np.arange(first)) else tuple(order.tolist())
    return Traced.of(computed(JOIN, operands, (first,), detail), arranged.shape, kind)


_TABLES = read_beside(__file__, "ufuncs.toml")
ARITHMETIC: Mapping[str, str] = _TABLES["arithmetic"]
COMPARISONS: Mapping[str, str] = _TABLES["comparisons"]
LOGICAL_NAMES: Mapping[str, str] = _TABLES["logical_names"]
EMPTY_REDUCTIONS: Mapping[str, float] = _TABLES["empty_reductions"]
CHOICE = "({} != 0.0 ? {} : {})"


def _plain_options(options: Mapping[str, Any], outputs: Any) -> dict[str, Any]:  # noqa: ANN401 - as numpy's
    """Return the options of a ufunc of numbers; with `where`, the entries that stay are numbers too."""
    numbers = {name: as_numbers(value) for name, value in options.items()}
    if "where" in options and outputs is not None:
        numbers["out"] = np.array(outputs[0].numbers())
    return numbers


def _called(
    ufunc: np.ufunc,
    inputs: Sequence[Any],
    options: Mapping[str, Any],
    outputs: Any,  # noqa: ANN401
) -> Traced:
    name = ufunc.__name__
    if name in PRODUCTS:
        return PRODUCTS[name](*map(as_traced, inputs))
    result = elementwise(name, *inputs)
    chosen = options.get("where", True)
    if chosen is True:
        return result
    return choose(chosen, result, outputs[0])


def elementwise(name: str, *inputs: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return a ufunc of its name, entry by entry."""
    arrays = [as_traced(each) for each in inputs]
    if name in LOGICAL_NAMES and all(each.kind == "b" for each in arrays):
        name = LOGICAL_NAMES[name]
    if name in COMPARISONS:
        return mapped(COMPARISONS[name], arrays, "b")
    if name not in ARITHMETIC:
        raise NotTraceable(f"it calls numpy.{name}, which has no exported form")
    whole = all(each.kind != "f" for each in arrays) and name != "divide"
    return mapped(ARITHMETIC[name], arrays, "i" if whole else "f")


def mapped(operation: str, arrays: Sequence[Traced], kind: str) -> Traced:
    """Return an operation in C, entry by entry, of arrays that are broadcast against each other."""
    shape = np.broadcast_shapes(*(each.shape for each in arrays))
    operands = [each.operand(shape) for each in arrays]
    return Traced.of(computed(MAP, operands, shape, operation), shape, kind)


def choose(chosen: Any, one: Any, other: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return `one` where chosen, else `other`."""
    arrays = [as_traced(each) for each in (chosen, one, other)]
    kind = max((each.kind for each in arrays[1:]), key="bif".index)
    return mapped(CHOICE, arrays, kind)


def reduced(
    name: str,
    array: Any,  # noqa: ANN401
    axis: Any = 0,  # noqa: ANN401
    keepdims: bool = False,
    initial: Any = None,  # noqa: ANN401
) -> Traced:
    """Return the reduction by a ufunc of its name over axes, None for all."""
    if name in LOGICAL_NAMES:
        name = LOGICAL_NAMES[name]
    if name not in EMPTY_REDUCTIONS:
        raise NotTraceable(f"it calls numpy.{name}.reduce, which has no exported form")
    table = as_traced(array)
    axes = _axes_of(axis, table.ndim)
    kept = tuple(size for i, size in enumerate(table.shape) if i not in axes)
    # The reduced axes are the last ones.
    rows = table.arranged(np.moveaxis(table.places, axes, range(-len(axes), 0)))
    result = Traced.plain(np.full(kept, EMPTY_REDUCTIONS[name]))
    if table.size:
        result = Traced.of(computed(REDUCE, [rows.operand()], kept, name), kept)
    logical = name.startswith("logical")
    if initial is not None:
        result = elementwise(name, result, float(initial))
    kind = "f"
    if logical:
        kind = "b"
    elif table.kind in "bi":
        kind = "i"
    result.kind = kind
    if keepdims:
        return np.expand_dims(result, axes)  # type: ignore[return-value]
    return result


def _axes_of(axis: int | Sequence[int] | None, ndim: int) -> tuple[int, ...]:
    """Return the numbers of axes, counted from the first one, for one axis, several, or None for all."""
    if axis is None:
        return tuple(range(ndim))
    axes = (axis,) if isinstance(axis, int) else tuple(axis)
    return tuple(each % ndim for each in axes)


def matmul(a: Traced, b: Traced) -> Traced:
    """Return a @ b, (..., i, j); vectors as numpy has them."""
    if a.ndim == 1:
        return matmul(a[None, :], b)[..., 0, :]
    if b.ndim == 1:
        return matmul(a, b[:, None])[..., 0]
    if b.shape[-2] != a.shape[-1]:
        raise ValueError(f"matmul: {a.shape} does not fit {b.shape}")
    products = elementwise("multiply", a[..., :, None, :], b.mT[..., None, :, :])
    return reduced("add", products, axis=-1)


def vecdot(a: Traced, b: Traced) -> Traced:
    """Return a·b over the last axis, (...)."""
    return reduced("add", elementwise("multiply", a, b), axis=-1)


PRODUCTS: Mapping[str, Callable[[Traced, Traced], Traced]] = {
    "matmul": matmul,
    "vecdot": vecdot,
    "matvec": lambda A, x: matmul(A, x[..., None])[..., 0],
    "vecmat": lambda x, A: matmul(x[..., None, :], A)[..., 0, :],
}
