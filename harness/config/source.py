"""Python files and modules of users: found, read, executed, sent to other processes; their errors as one line."""

import ast
import contextlib
import hashlib
import importlib
import importlib.util
import os
import re
import site
import sys
import sysconfig
import traceback
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Self, TypeAlias

from servobench.plant.contract.checksums import digest
from servobench.plant.contract.faults import ConfigurationError, one_line
from servobench.plant.contract.files import is_file, reason, user_path
from servobench.plant.contract.settings import suggest

Name: TypeAlias = tuple[str, ...]  # name of a module, by its parts

PLACE = re.compile(
    r"(?:(?P<alias>\w+)=)?(?:(?P<file>.+\.(?i:py))(?::(?P<name>\w+))?|(?P<module>[\w.]+):(?P<attribute>\w+))"
)
PACKAGE = "servobench"
PACKAGE_FOLDER = Path(__file__).parents[2]
_MODULES_OF_USERS: set[str] = set()  # top-level modules that users named


@dataclass(frozen=True)
class SourceFile:
    """A Python file as it was read. It can be pickled: a process that receives it carries out the same text."""

    path: Path  # absolute path of the file
    text: str  # its content

    @classmethod
    def read(cls, given: str) -> Self:
        """Read a file.

        Raises:
            ConfigurationError: it cannot be read; names the nearest file beside it.
        """
        try:
            path = (present_folder() / user_path(given)).resolve()
            return cls(path, path.read_text(encoding="utf-8"))
        except FileNotFoundError as error:
            beside = (
                [each.name for each in path.parent.glob("*.[pP][yY]")]
                if path.parent.is_dir()
                else []
            )
            hint = (
                suggest(path.name, beside)
                if beside
                else f"{show(path.parent)} holds no Python file"
            )
            hint = (
                "a name before = has letters, digits and _ only"
                if "=" in given.partition("/")[0]
                else hint
            )
            raise ConfigurationError(f"there is no file {given}: {hint}") from error
        except (OSError, ValueError) as error:
            raise ConfigurationError(f"{given} cannot be read: {reason(error)}") from error

    @cached_property
    def digest(self) -> str:
        """SHA-256 of the text."""
        return hashlib.sha256(self.text.encode()).hexdigest()

    def load(self) -> ModuleType:
        """Carry out the file, once in a process, and return its module; files beside it can be imported.

        Raises:
            ConfigurationError: it cannot be executed; one line with file and line number.
        """
        # The name follows from path and text, so it is the same in every process.
        place = hashlib.sha256(f"{self.path}\n{self.digest}".encode()).hexdigest()[:12]
        name = f"servobench_file_{self.path.stem}_{place}"
        if name in sys.modules:
            return sys.modules[name]
        make_importable(self.path.parent)
        self._check_neighbours()
        module = ModuleType(name)
        module.__file__, module.__package__ = str(self.path), ""
        sys.modules[name] = module
        try:
            with contextlib.chdir(present_folder()):  # the folder is the same after the import
                exec(compile(self.text, str(self.path), "exec"), vars(module))
        except BaseException as error:
            del sys.modules[name]
            if isinstance(error, Exception | SystemExit):
                raise ConfigurationError(describe_at(error)) from error
            raise
        return module

    def _check_neighbours(self) -> None:
        """Refuse an import of a file beside this one if another module of that name would be taken.

        A process has one module of a name: the `helper.py` of a second folder would silently be that of the first.
        """
        importlib.invalidate_caches()
        for file, line, (name, *_) in traced_imports(self.path, self.path.parent):
            beside = next(_files(self.path.parent, (name,)), None)
            if beside is None or name == PACKAGE:
                continue
            taken, beside = _origin(name), beside.resolve()
            if taken is not None and taken != beside:
                raise ConfigurationError(
                    f"{show(file)}:{line}: import {name} would take {show(taken)} instead of {show(beside)}, as a "
                    "process has one module of a name; give one of them another name"
                )


def _origin(name: str) -> Path | None:
    """Return the file that an import would take; None where none is known."""
    try:
        spec = importlib.util.find_spec(name)
    except (ImportError, ValueError):  # an own module has no spec
        file = getattr(sys.modules.get(name), "__file__", None)
        return Path(file).resolve() if file else None
    if spec is None or not spec.origin:
        return None
    if spec.has_location:
        return Path(spec.origin).resolve()
    return Path(f"the built-in {name}")


def present_folder() -> Path:
    """Return the present folder; a `ConfigurationError` says that it was deleted."""
    try:
        return Path.cwd()
    except FileNotFoundError as error:
        raise ConfigurationError(
            "the present folder was deleted; change to one that exists"
        ) from error


def check_present_folder() -> None:
    """Refuse a present folder in which no other process can start.

    Raises:
        ConfigurationError: it was deleted, or this user must not enter it.
    """
    folder = present_folder()
    try:
        os.chdir(folder)
    except OSError as error:
        raise ConfigurationError(
            f"the present folder {folder} cannot be entered: {reason(error)}; change to another one"
        ) from error


@contextlib.contextmanager
def same_folder() -> Iterator[None]:
    """Return to the present folder after code that may change it, so that names of files keep their meaning."""
    folder = None
    with contextlib.suppress(OSError):
        folder = Path.cwd()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):  # It is deleted, or this user must not enter it.
            os.chdir(folder or ".")


def make_importable(folder: Path, *, first: bool = False) -> None:
    """Let modules in a folder be imported; those that can be imported without it come first, unless it is `first`."""
    if str(folder) not in sys.path:
        sys.path.insert(0 if first else len(sys.path), str(folder))


def describe_at(error: BaseException) -> str:
    """Return an error as one line, `FILE:LINE: KIND: MESSAGE`, with the last place in code of users."""
    if isinstance(error, SyntaxError) and error.filename:
        place, message = f"{show(Path(error.filename))}:{error.lineno}: ", error.msg
    else:
        frames = reversed(traceback.extract_tb(error.__traceback__))
        place, message = (
            _first_place((frame.filename, frame.lineno) for frame in frames),
            str(error),
        )
    return place + one_line(f"{type(error).__name__}: {message}").rstrip(":")


def place_in_trace(trace: str) -> str:
    """Return `FILE:LINE: ` of the innermost line of users in a trace of `faulthandler`; "" if there is none."""
    return _first_place(re.findall(r'File "(.+?)", line (\d+)', trace))


def _first_place(places: Iterable[tuple[str, object]]) -> str:
    return next((f"{show(Path(file))}:{line}: " for file, line in places if is_users(file)), "")


def is_users(file: str) -> bool:
    """Return whether a file is code of users: a script, a cell of a notebook, a plug-in or a module that they named.

    The files of this package, of the standard library and of other installed packages are not.
    """
    if file.startswith("<"):
        return file.startswith("<ipython")
    path = Path(file)
    if path.is_relative_to(PACKAGE_FOLDER):
        return False
    folders = [folder for folder in _libraries() if path.is_relative_to(folder)]
    if not folders:
        return True
    package = path.relative_to(max(folders, key=len)).parts[0].removesuffix(".py")
    return package in _MODULES_OF_USERS or package in _plugin_packages()


@cache
def _plugin_packages() -> frozenset[str]:
    """Return the top-level packages of other distributions that publish something for this package."""
    found = entry_points()
    points = (
        each
        for group in found.groups
        if group.startswith(f"{PACKAGE}.")
        for each in found.select(group=group)
    )
    return frozenset(point.module.partition(".")[0] for point in points) - {PACKAGE}


@cache
def _libraries() -> tuple[str, ...]:
    """Return the folders of the standard library and of installed packages."""
    paths = (sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib"))
    return *paths, *site.getsitepackages(), site.getusersitepackages()


def show(path: Path) -> str:
    """Return a path as a user reads it best: relative to the present folder where it lies below it."""
    here = present_folder()
    if path.is_relative_to(here):
        return str(path.relative_to(here))
    return str(path)


def find_place(text: str) -> re.Match[str] | None:
    """Return the parts of the place of code, `[NAME=]FILE.py[:NAME]` or `[NAME=]MODULE:NAME`; None for other texts.

    A file whose path holds an equals sign is taken as it stands if it exists.
    """
    found = PLACE.fullmatch(text)
    if found is None or not found["alias"] or not found["file"]:
        return found
    if is_file(text[: found.end("file")]):
        return PLACE.fullmatch(f"./{text}")
    return found


def is_place(text: str) -> bool:
    """Return whether a text says where code stands, and is no name; of a module, whether there is such a one."""
    found = find_place(text)
    if found is None or found["file"] is not None:
        return found is not None
    make_importable(present_folder())
    try:
        return importlib.util.find_spec(found["module"].partition(".")[0]) is not None
    except (ImportError, ValueError):
        return False


def count_as_users(module: str) -> None:
    """Let a module that a user names count as code of users, though it lies among installed packages."""
    _MODULES_OF_USERS.add(module.partition(".")[0])


def import_user_module(module: str) -> ModuleType:
    """Import a module that a user named; modules in the present folder can be imported, too.

    Raises:
        ConfigurationError: it cannot be imported; one line with the place in it.
    """
    make_importable(present_folder())
    count_as_users(module)
    try:
        with contextlib.chdir(present_folder()):
            return importlib.import_module(module)
    except (Exception, SystemExit) as error:
        raise ConfigurationError(describe_at(error)) from error


def digest_of_module(module: str) -> str:
    """Return the SHA-256 of the file of a module that is imported; empty where it has none."""
    file = Path(getattr(sys.modules.get(module), "__file__", None) or "")
    if file.is_file():
        return digest(file)
    return ""


def neighbours(file: Path, root: Path) -> list[Path]:
    """Return the files below a folder that a file imports, directly or through one of them; not the file itself.

    Args:
        file: the file.
        root: the folder from which its imports start.
    """
    names = {name for _, _, name in traced_imports(file, root)}
    return sorted({path for name in names for path in _files(root, name)} - {file})


def code_digest(file: Path) -> str:
    """Return one SHA-256 of a file of code and the modules that it imports from its folder; it holds no path."""
    digests = [digest(path) for path in (file, *neighbours(file, file.parent))]
    return hashlib.sha256("".join(digests).encode()).hexdigest()


def traced_imports(file: Path, root: Path) -> Iterator[tuple[Path, int, Name]]:
    """Yield each import of a file and of the files below a folder that it imports: file, line and name.

    Nothing is yielded of a file that cannot be read. Arguments as of `neighbours`.
    """
    waiting, seen = [file], {file}
    while waiting:
        importing = waiting.pop()
        try:
            tree = ast.parse(importing.read_text(encoding="utf-8"))
        except (OSError, SyntaxError, ValueError):
            continue
        package = importing.parent.relative_to(root).parts
        for node in ast.walk(tree):
            for name in _names(node, package):
                yield importing, getattr(node, "lineno", 0), name
                found = [path for path in _files(root, name) if path not in seen]
                seen.update(found)
                waiting += found


def _names(node: ast.AST, package: Name) -> Iterator[Name]:
    """Yield the names that a statement imports, those of modules and of objects that may be modules."""
    match node:
        case ast.Import(names=names):
            yield from (tuple(each.name.split(".")) for each in names)
        case ast.ImportFrom(module=module, names=names, level=level):
            begin = package[: len(package) + 1 - level] if level else ()
            name = (*begin, *module.split(".")) if module else begin
            yield from ((*name, each.name) for each in names)


def _files(root: Path, name: Name) -> Iterator[Path]:
    """Yield the files that an import of a name carries out: those of its packages and its own."""
    for length in range(1, len(name) + 1):
        place = root.joinpath(*name[:length])
        for path in (place / "__init__.py", place.with_name(f"{place.name}.py")):
            if path.is_file():
                yield path
                break
