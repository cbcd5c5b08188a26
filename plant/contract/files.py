"""Atomic writing of files, and reading of a user's TOML, YAML and CSV with errors of one line."""

from __future__ import annotations

import io
import os
import re
import shutil
import threading
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import wraps
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

from servobench.plant.contract.faults import ConfigurationError, configuration_errors

if TYPE_CHECKING:
    from servobench.plant.contract.checks import FloatArray

# The begin of a formula that a spreadsheet runs: in a cell, or behind a mark that some countries put between cells.
FORMULA = re.compile(
    "^(?=[=+\\-@\t\uff1d\uff0b\uff0d\uff20])|(?<=[;\t])(?=[=+\\-@\uff1d\uff0b\uff0d\uff20])"
)
CONTROL = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")
TOML_TEXT = re.compile(  # a text of any of four kinds, or a comment
    r'''"""(?:[^"\\]++|\\.|""?+(?!"))*+"{3,5}|\'{3}.*?\'{3,5}|"(?:[^"\\\n]++|\\.)*+"|'[^'\n]*'|#[^\n]*''',
    re.DOTALL,
)
MAX_KEY_PARTS = 32
TOML_LONG_KEY = re.compile(rf"""(?<![\w"-])(?:[\w"-]++[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS},}}""")
MAX_TOML = 500_000  # [letters] beside texts and comments
MAX_KEY = 10_000  # [letters]
# Marks between a path and other parts of a word: NAME=PATH:CLASS, fmu:PATH
AROUND_FILE = re.compile("[=:]")
MAX_MARKS = 16  # that a path in a list may have
TIME = "time_s"  # column of a table
TIME_KINDS = ("m", "M")  # numpy's kinds of durations and dates
SECONDS = f"for a column {TIME} in s, take (times - times[0]).total_seconds(), of a column by .dt"
MAX_NUMBER = 1e30  # beyond which no quantity is, and squares of errors are near the largest number
# Name of a file that is being written, or whose process was killed
PARTIAL = re.compile(r"\..+-\d+-\d+")


Write: TypeAlias = Callable[[Path], object]  # makes a file or a folder at a path
Read = TypeVar("Read")
Record: TypeAlias = dict[str, Any]  # values by name: of TOML or YAML a table, of JSON an object
Changes: TypeAlias = dict[Path, int]  # when files were changed [ns]; 0 for one that is not there

# Changes of the files that the function which is called by `kept_while_unchanged` has read
_CHANGES: ContextVar[Changes] = ContextVar("changes")


def write_atomically(path: Path, write: Write) -> None:
    """Write a file under another name in the same folder, then rename it.

    Args:
        path: the file; an old one is replaced.
        write: writes the content to the path that it is given.
    """
    partial = partial_path(path)
    try:
        partial.touch()  # a place without room for a file is refused before the content is made
        write(partial)
        sync(partial)
        partial.replace(path)
        sync(path.parent)
    except OSError as error:
        if error.errno is not None and str(error.filename or partial) == str(
            partial
        ):  # a full disk names no file
            error.filename = str(path)  # that of the user
        raise
    finally:
        if partial.exists():  # not below a file, for instance
            partial.unlink()


def write_text(path: Path, text: str) -> None:
    """Write a text in UTF-8, atomically."""
    write_atomically(path, lambda partial: partial.write_text(text, encoding="utf-8"))


@contextmanager
def writing_together(folder: Path) -> Iterator[Path]:
    """Yield a new folder for files that belong together; they get their places in `folder` once all of them are there.

    A folder that is new gets its name at once; in one that is there, files of the same names are replaced.
    """
    partial = partial_path(folder / "files")
    if not folder.exists():
        partial = partial_path(folder)
    try:
        partial.mkdir(parents=True)
        yield partial
        if partial.parent != folder and any(partial.iterdir()):
            partial.rename(folder)
            return
        for path in sorted(partial.rglob("*")):
            place = folder / path.relative_to(partial)
            if path.is_dir():
                place.mkdir(exist_ok=True)
            else:
                path.replace(place)
    except OSError as error:
        _name_whole(error, partial, folder)
        raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _name_whole(error: OSError, partial: Path, whole: Path) -> None:
    """Let an error name the file or folder of the user in place of one that is being written."""
    if error.filename is not None:
        error.filename = str(error.filename).replace(str(partial), str(whole))
    if error.strerror is not None:
        error.strerror = error.strerror.replace(str(partial), str(whole))


@contextmanager
def accessing(path: Path | None, kind: str = "", done: str = "written") -> Iterator[None]:
    """Raise a `ConfigurationError` where a file or folder of a kind, or by default a file in it, cannot be `done`.

    It names another file that was read meanwhile and cannot be. Without a path, any file may be the one.
    """
    if path is not None and done == "read":
        _CHANGES.get({})[path] = _last_change(path)
    try:
        yield
    except OSError as error:
        file = Path(str(error.filename or path))
        elsewhere = (
            path is not None and path not in (file, *file.parents) and file not in path.parents
        )
        if done == "written" and elsewhere:
            raise ConfigurationError(
                f"{file}, which {path} needs, cannot be read: {reason(error)}"
            ) from error
        if done == "written" and (error.errno is None or not (path or error.filename)):
            raise  # It is an error of a library that draws, or of no file in particular.
        named = f"{kind} {path}" if kind else error.filename or path
        raise ConfigurationError(f"{named} cannot be {done}: {reason(error)}") from error


def kept_while_unchanged(read: Callable[..., Read]) -> Callable[..., Read]:
    """Keep what a function makes of files, by its arguments, until one of the files that it read is another one."""
    kept: dict[tuple[Any, ...], tuple[Read, Changes]] = {}

    @wraps(read)
    def find(*arguments: Any) -> Read:  # noqa: ANN401 - those of the function
        if arguments not in kept or not _are_unchanged(kept[arguments][1]):
            noted: Changes = {}
            token = _CHANGES.set(noted)
            try:
                kept[arguments] = read(*arguments), noted
            finally:
                _CHANGES.reset(token)
        found, changes = kept[arguments]
        # A function around this one that keeps its answer has to notice them, too.
        _CHANGES.get({}).update(changes)
        return found

    return find


def _are_unchanged(changes: Changes) -> bool:
    return all(_last_change(path) == change for path, change in changes.items())


def _last_change(path: Path) -> int:
    """Return when a file was changed [ns]; 0 where that is not known, and whoever reads it says why."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0


def write_csv(table: Any, path: Path) -> None:  # noqa: ANN401 - pandas need not be imported here
    """Write a DataFrame as CSV, atomically.

    A text that a spreadsheet would run as a formula gets an apostrophe; signs that some readers take for the end of a
    row are written by their number.
    """

    def quoted(cell: Any) -> Any:  # noqa: ANN401 - a cell of any kind
        if not isinstance(cell, str):
            return cell
        return FORMULA.sub("'", harmless(cell))

    texts = {
        str(name): column.map(quoted)
        for name, column in table.items()
        if column.dtype.kind not in "biufM"
    }
    safe = table.assign(**texts).rename(columns=quoted)
    write_atomically(path, lambda partial: safe.to_csv(partial, index=False))


def read_toml(kind: str, path: Path) -> Record:
    """Return the content of a TOML file.

    Args:
        kind: of the file, for error messages, such as "mapping".
        path: the file.

    Raises:
        ConfigurationError: it cannot be read, or is not valid TOML.
    """
    text = read_text(kind, path)
    with configuration_errors(f"{kind} {path} is not valid TOML: ", RecursionError):
        return parse_toml(text)


def yaml_loader() -> Any:  # noqa: ANN401 - a class of PyYAML's, which is not imported here
    """Return a class that loads YAML as `yaml.SafeLoader`, but raises a `yaml.YAMLError` for a key given twice."""
    import yaml  # noqa: PLC0415 - few commands read such a file

    class Loader(yaml.SafeLoader):
        """`SafeLoader` takes the last of two equal keys."""

        def construct_mapping(self, node: Any, deep: bool = False) -> Any:  # noqa: ANN401 - as PyYAML has it
            keys = Counter(str(key.value) for key, _ in node.value)
            for key, count in keys.items():
                if count > 1:
                    raise yaml.constructor.ConstructorError(
                        None, None, f"{key} is there twice", node.start_mark
                    )
            return super().construct_mapping(node, deep)

    return Loader


def parse_toml(text: str) -> Record:
    """Return the content of a text in TOML.

    Time and memory of the parser grow with the square of the parts of a key, and each part has tables of its own. A
    long key in quotes costs those who look for a similar one.

    Raises:
        ValueError: it is not valid, or of keys that are too long, have too many parts, or are too many.
    """
    import tomllib  # noqa: PLC0415 - help pages are printed without it

    bare = TOML_TEXT.sub('"', text)
    if long := TOML_LONG_KEY.search(bare):
        raise ValueError(
            f"the key {long[0][:20]}… has more than {MAX_KEY_PARTS} parts; nest no deeper"
        )
    if len(bare) > MAX_TOML:
        raise ValueError(
            f"it has {len(bare)} letters beside texts and comments; at most {MAX_TOML} are read"
        )
    content = tomllib.loads(text)
    _refuse_long_keys(content)
    return content


def _refuse_long_keys(content: object) -> None:
    """Raise a `ValueError` for a key of too many letters in a table or list, or in those within."""
    within = content
    if isinstance(content, dict):
        for key in content:
            if len(key) > MAX_KEY:
                raise ValueError(
                    f"the key {key[:20]}… has {len(key)} letters; at most {MAX_KEY} are read"
                )
        within = content.values()
    if isinstance(within, (str, bytes)) or not isinstance(within, Iterable):
        return
    for part in within:
        _refuse_long_keys(part)


def read_text(kind: str, path: Path) -> str:
    """Return the text of a file without the byte-order mark that some editors begin it with; see `read_toml`."""
    with accessing(path, kind, "read"):
        try:
            return path.read_text(encoding="utf-8-sig")
        except UnicodeDecodeError as error:
            raise ConfigurationError(
                f"{kind} {path} is no text in UTF-8; save it in this encoding"
            ) from error


def read_table(kind: str, path: Path) -> Any:  # noqa: ANN401 - a DataFrame, as above
    """Return the table of a Parquet file or else of a CSV file, of which blanks do not count; see `read_toml`.

    Levels of the index that have a name are columns. The name of a column in several levels is the last of them.
    """
    import pandas as pd  # noqa: PLC0415 - lists of names start without it

    text = None
    if path.suffix.lower() != ".parquet":
        text = read_text(kind, path)
    header = (text or ",").partition("\n")[0].strip()
    if "," not in header and (marks := [mark for mark in (";", "\t", " ") if mark in header]):
        raise ConfigurationError(
            f"{kind} {path} has {marks[0]!r} between its columns; write commas, and numbers as 0.5"
        )
    with configuration_errors(f"{kind} {path} is no table: ", OSError):
        is_csv = text is not None
        source = io.StringIO(text)
        table = pd.read_csv(source, skipinitialspace=True) if is_csv else pd.read_parquet(path)
    # With more cells in rows than in the header, the first cells are taken for names of rows.
    if is_csv and type(table.index) is not pd.RangeIndex:
        raise ConfigurationError(
            f"{kind} {path} has rows of more cells than its header; write numbers as 0.5"
        )
    levels = [name for name in table.index.names if name is not None and name not in table]
    if not levels and table.index.dtype.kind in TIME_KINDS and TIME not in table:
        raise ConfigurationError(f"{kind} {path} has times as its index without a name; {SECONDS}")
    if levels:
        table = table.reset_index(level=levels)
    names = [_plain_column(name) for name in table]
    if doubled := [name for name in names if names.count(name) > 1]:
        raise ConfigurationError(f"{kind} {path} has two columns {doubled[0]!r}; leave one out")
    return table.reset_index(drop=True).set_axis(names, axis=1)


def _plain_column(name: object) -> str:
    """Return the name of a column as a text without blanks around it; of several levels the last that is not empty."""
    if not isinstance(name, tuple):
        return str(name).strip()
    texts = [str(part).strip() for part in name]
    return next(filter(None, reversed(texts)), "")


def numbers_of(what: str, table: Any, names: Sequence[str]) -> FloatArray:  # noqa: ANN401 - as above
    """Return the numbers of columns of a DataFrame, (k, len(names)); `what` names them in messages.

    Raises:
        ConfigurationError: one of them is missing or has something else than finite numbers, or there are no rows.
    """
    import numpy as np  # noqa: PLC0415 - as above
    import pandas as pd  # noqa: PLC0415 - as above

    lacking = [f"column {name}" for name in names if name not in table]
    if not lacking and table.empty:
        lacking.append("rows")
    if lacking:
        raise ConfigurationError(f"{what} has no {lacking[0]}; it needs {', '.join(names)}")
    chosen = table[list(names)]
    for name, kind in chosen.dtypes.items():
        if kind.kind in (*TIME_KINDS, "c") or isinstance(kind, pd.PeriodDtype):
            raise ConfigurationError(f"{what}: {name} must be numbers, got {kind}; {SECONDS}")
        if isinstance(kind, pd.CategoricalDtype):
            chosen = chosen.astype({name: object})
    with configuration_errors(f"{what} has a number without end: ", OverflowError):
        # Truth values are texts if another cell of the column is none.
        replaced = chosen.replace({"True": 1, "False": 0})
        numeric = replaced.apply(pd.to_numeric, errors="coerce")
        values = numeric.to_numpy(np.float64, na_value=np.nan)
    within = np.abs(values) < MAX_NUMBER
    if not within.all():
        row, column = np.argwhere(~within)[0].tolist()
        cell = str(table[names[column]].iloc[row])
        came = "nothing, or nan" if cell == "nan" else repr(cell)
        wanted = "a finite number"
        if np.isfinite(values[row, column]):
            wanted = f"a number below {MAX_NUMBER:g}"
        raise ConfigurationError(f"{what}, row {row}: {names[column]} must be {wanted}, got {came}")
    return values


def harmless(text: str) -> str:
    """Return a text in which signs that a terminal obeys, or cannot print, are written by their number."""
    return CONTROL.sub(lambda found: f"\\u{ord(found[0]):04x}", text)


def reason(error: Exception) -> str:
    """Return the reason of an error about a file; for an error of the system without its number and path."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    return str(error)


def user_path(text: str) -> Path:
    """Return a path as written by a user, in which ~ stands for a home folder.

    Raises:
        ConfigurationError: there is no such home folder.
    """
    try:
        return Path(text).expanduser()
    except RuntimeError as error:
        raise ConfigurationError(f"path {text!r} names a home folder that is not known") from error


def is_file(text: str) -> bool:
    """Return whether a text is the path of a file with an ending."""
    if not PurePath(text).suffix:
        return False
    try:
        return user_path(text).is_file()
    except (OSError, ValueError):  # no path at all, or one that may not be looked at
        return False


def divisions(text: str, mark: str) -> list[tuple[str, str]]:
    """Return a text as a whole, and the parts before and behind each place where a mark stands in it."""
    found = [(text, "")]
    for place in re.finditer(re.escape(mark), text):
        before = text[: place.start()]
        behind = text[place.end() :]
        found.append((before, behind))
    return found


def split_words(text: str, known: Container[str] = ()) -> tuple[str, ...]:
    """Split a comma-separated list, in which a known name and a file that exists may have commas themselves."""
    return tuple(filter(None, words_between(text, ",", known)))


def words_between(text: str, mark: str, known: Container[str] = ()) -> Iterator[str]:
    """Yield the words between marks, also empty ones; a known name and a file that exists may have marks themselves.

    The path of the file may stand between other parts of a word, but has all of its marks.
    """
    parts = text.split(mark)
    while parts:
        for size in range(min(len(parts), MAX_MARKS + 1), 0, -1):
            word = mark.join(parts[:size]).strip()
            pieces = (word, word.partition("=")[2], *AROUND_FILE.split(word))
            whole = [piece for piece in pieces if piece.count(mark) == size - 1]
            if size == 1 or word in known or any(map(is_file, whole)):
                break
        del parts[:size]
        yield word


def partial_path(path: Path) -> Path:
    """Return the name under which this thread writes a file."""
    return path.with_name(f".{path.name}-{os.getpid()}-{threading.get_ident()}")


def sync(path: Path) -> None:
    """Wait until the content of a file, or the list of files of a folder, is on the disk.

    Without it a file may have its name before it has its content, so that a power cut leaves an empty one.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def point_latest(folder: Path) -> None:
    """Point the link `latest` in the parent folder at `folder`; where links cannot be made, nothing happens."""
    link = folder.parent / "latest"
    partial = folder.parent / f".latest-{os.getpid()}"
    if link.exists() and not link.is_symlink():
        return
    try:
        partial.symlink_to(folder.name, target_is_directory=True)
        partial.replace(link)
    except OSError:
        partial.unlink(missing_ok=True)
