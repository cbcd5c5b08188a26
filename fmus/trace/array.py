"""An array whose numbers are CasADi expressions, in the place of one of numpy.

An array is a table of places in a buffer, one column of expressions. Whatever numpy does to the order and the shape of
an array it does to the table, so that views, slices and broadcasting are numpy's own; writing to a view changes the
buffer that it shares. A buffer holds plain numbers until an expression is written to it, and such an array can be used
wherever numpy wants numbers.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, ClassVar, TypeAlias

import casadi
import numpy as np
import numpy.typing as npt
from numpy.lib.mixins import NDArrayOperatorsMixin

Expression: TypeAlias = Any  # of CasADi: MX
Places: TypeAlias = npt.NDArray[np.intp]
DTYPES = {"b": np.dtype(np.bool_), "i": np.dtype(np.int_), "f": np.dtype(np.float64)}


class NotTraceable(ValueError):
    """Code cannot be recorded: it decides by a number of the run, or calls what has no expression."""


class Buffer:
    """Numbers or expressions, which arrays share.

    Attributes:
        content: (N,) numbers, or an expression (N, 1).
    """

    def __init__(self, content: Any) -> None:  # noqa: ANN401 - numbers or an expression
        """Hold a content."""
        self.content = content

    @property
    def constant(self) -> bool:
        """Whether it holds plain numbers."""
        return isinstance(self.content, np.ndarray)


class Traced(NDArrayOperatorsMixin):
    """An array of expressions.

    Attributes:
        buffer: of its numbers.
        places: of its entries in the buffer.
        kind: of its numbers, as numpy's: "b", "i" or "f".
    """

    ufunc: ClassVar[Callable[..., Any]]
    """Carries out a ufunc; `servobench.fmus.trace.namespace` sets it."""
    function: ClassVar[Callable[..., Any]]
    """Carries out another function of numpy; `servobench.fmus.trace.namespace` sets it."""
    flags: ClassVar[SimpleNamespace] = SimpleNamespace(writeable=True)

    def __init__(self, buffer: Buffer, places: Places, kind: str = "f") -> None:
        """Show a part of a buffer."""
        self.buffer, self.places, self.kind = buffer, places, kind

    @classmethod
    def of(cls, expression: Expression, shape: tuple[int, ...], kind: str = "f") -> Traced:
        """Return the array (shape) of an expression (N, 1), in row-major order."""
        return cls(Buffer(expression), np.arange(expression.numel()).reshape(shape), kind)

    @classmethod
    def plain(cls, numbers: npt.NDArray[Any]) -> Traced:
        """Return an array of numbers to which expressions can be written."""
        kind = numbers.dtype.kind if numbers.dtype.kind in DTYPES else "f"
        return cls(
            Buffer(np.array(numbers, dtype=np.float64).reshape(-1)),
            np.arange(numbers.size).reshape(numbers.shape),
            kind,
        )

    @property
    def constant(self) -> bool:
        """Whether its entries are plain numbers."""
        return self.buffer.constant

    def numbers(self) -> npt.NDArray[Any]:
        """Return the numbers of a constant array.

        Raises:
            NotTraceable: it has expressions.
        """
        if not self.constant:
            raise NotTraceable("it decides by a number that is known in the run only")
        values: npt.NDArray[Any] = self.buffer.content[self.places]
        return values.astype(DTYPES[self.kind])

    def flat(self) -> Expression:
        """Return its entries as an expression (size, 1), in row-major order."""
        if self.constant:
            return casadi.MX(casadi.DM(self.buffer.content[self.places.reshape(-1)]))
        return gathered(self.buffer.content, self.places)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:  # noqa: ANN401
        """Carry out a ufunc."""
        return Traced.ufunc(ufunc, method, inputs, options)

    def __array_function__(self, function: Any, types: Any, arguments: Any, options: Any) -> Any:  # noqa: ANN401
        """Carry out another function."""
        del types
        return Traced.function(function, arguments, options)

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:  # noqa: ANN401
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
        if isinstance(key, Traced):
            return self[key.numbers()] if key.constant or key.kind == "b" else picked(self, key)
        return Traced(self.buffer, np.asarray(self.places[_plain_key(key)]), self.kind)

    def __setitem__(self, key: Any, value: Any) -> None:  # noqa: ANN401 - any index, any array
        """Write to the buffer."""
        places = np.asarray(self.places[_plain_key(key)])
        if isinstance(value, Traced) and not value.constant:
            content = casadi.MX(self.buffer.content) if not self.constant else casadi.MX(casadi.DM(self.buffer.content))
            content.nz[places.reshape(-1).tolist()] = spread(value, places.shape).flat()
            self.buffer.content = content
        elif self.constant:
            numbers = value.numbers() if isinstance(value, Traced) else value
            self.buffer.content = self.buffer.content.copy()
            self.buffer.content[places] = numbers
        else:
            numbers = np.broadcast_to(np.asarray(value, dtype=np.float64), places.shape)
            content = casadi.MX(self.buffer.content)
            content.nz[places.reshape(-1).tolist()] = casadi.MX(casadi.DM(numbers.reshape(-1)))
            self.buffer.content = content

    def arranged(self, places: Places) -> Traced:
        """Return a view with another table of places."""
        return Traced(self.buffer, np.asarray(places), self.kind)

    @property
    def shape(self) -> tuple[int, ...]:
        """Sizes of its axes."""
        return self.places.shape

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return self.places.ndim

    @property
    def size(self) -> int:
        """Number of entries."""
        return self.places.size

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its numbers, as numpy's."""
        return DTYPES[self.kind]

    @property
    def T(self) -> Traced:
        """Transpose."""
        return self.arranged(self.places.T)

    @property
    def mT(self) -> Traced:
        """Transpose of the last two axes."""
        return self.arranged(self.places.mT)

    def reshape(self, *shape: Any) -> Traced:  # noqa: ANN401 - as numpy's
        """Return the entries in another shape."""
        return self.arranged(self.places.reshape(*shape))

    def swapaxes(self, one: int, other: int) -> Traced:
        """Return a view with two axes exchanged."""
        return self.arranged(self.places.swapaxes(one, other))

    def copy(self) -> Traced:
        """Return a copy with a buffer of its own."""
        return Traced.plain(self.numbers()) if self.constant else Traced.of(self.flat(), self.shape, self.kind)

    def astype(self, dtype: npt.DTypeLike) -> Traced:
        """Return the numbers as another type; whole ones are cut off."""
        kind = np.dtype(dtype).kind
        if kind == "i" and self.kind == "f":
            cut: Traced = np.where(self < 0.0, np.ceil(self), np.floor(self))  # type: ignore[assignment]
            return Traced(cut.buffer, cut.places, "i")
        if kind == "b" and self.kind != "b":
            return self != 0.0  # type: ignore[no-any-return]
        return Traced(self.buffer, self.places, kind)

    def setflags(self, **flags: bool) -> None:
        """Take note of nothing: who writes where is for numpy to check."""

    def tobytes(self) -> bytes:
        """Return bytes that equal those of no other array, so that a memo of it is never used for another one."""
        return b"traced %d %d" % (id(self), next(_COUNTER))

    def _called(self, name: str, *arguments: Any, **options: Any) -> Any:  # noqa: ANN401 - as numpy's
        return getattr(np, name)(self, *arguments, **options)

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401 - a method of numpy's arrays
        """Return a method that numpy has as a function as well."""
        if name not in METHODS:
            raise AttributeError(f"Traced has no attribute {name!r}")
        return lambda *arguments, **options: self._called(name, *arguments, **options)


def _counter() -> Iterator[int]:
    number = 0
    while True:
        yield number
        number += 1


_COUNTER = _counter()
METHODS = {
    "sum", "mean", "max", "min", "any", "all", "argmin", "argmax", "cumsum", "trace", "diagonal", "take", "dot",
    "repeat", "ravel", "squeeze", "transpose", "clip",
}  # fmt: skip


def _plain_key(key: Any) -> Any:  # noqa: ANN401 - any index
    if isinstance(key, tuple):
        return tuple(_plain_key(each) for each in key)
    return key.numbers() if isinstance(key, Traced) else key


def gathered(content: Expression, places: Places) -> Expression:
    """Return entries of an expression (N, 1) as one (size, 1)."""
    flat = places.reshape(-1)
    if flat.size == content.numel() and np.array_equal(flat, np.arange(flat.size)):
        return content
    if content.numel() == 1:
        return casadi.repmat(content, flat.size, 1)
    return content.nz[flat.tolist()] if flat.size else casadi.MX(0, 1)


def spread(array: Traced, shape: tuple[int, ...]) -> Traced:
    """Return an array broadcast to a shape."""
    return array.arranged(np.broadcast_to(array.places, shape))


def as_traced(value: Any) -> Traced:  # noqa: ANN401 - anything array-like
    """Return an array as one of these."""
    return value if isinstance(value, Traced) else Traced.plain(np.asarray(value))


def picked(array: Any, index: Traced) -> Traced:  # noqa: ANN401 - any array
    """Return the entries that an index (†), known in the run only, names along the first axis, (†, *)."""
    table = as_traced(array)
    rest = table.shape[1:]
    width = int(np.prod(rest))
    begin = casadi.vec(casadi.repmat(width * index.flat().T, width, 1))
    along = np.tile(np.arange(width, dtype=np.float64), index.size)
    return Traced.of(table.flat().nz[begin + casadi.DM(along)], (*index.shape, *rest), table.kind)


def joined(arrays: Sequence[Any], arrange: Callable[[list[Places]], Places]) -> Traced:
    """Return arrays as one: `arrange` puts the tables of their places together as numpy would the arrays."""
    parts = [as_traced(array) for array in arrays]
    ends = np.cumsum([0, *(part.size for part in parts)])
    tables = [first + np.arange(part.size).reshape(part.shape) for first, part in zip(ends, parts, strict=False)]
    kind = max((part.kind for part in parts), key="bif".index)
    content = casadi.vertcat(*(part.flat() for part in parts))
    return Traced(Buffer(content), arrange(tables), kind)
