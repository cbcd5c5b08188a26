"""Compiles the C sources of an FMU with the system's C compiler for this machine, or with zig for other platforms."""

import importlib.util
import os
import platform
import shlex
import shutil
import struct
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

from servobench.plant.fmu.dialect import DIALECTS

# No fused multiply-add, so that every platform rounds alike; only the FMI functions are visible.
CODE = ("-std=c11", "-O3", "-ffp-contract=off", "-fvisibility=hidden", "-shared")
COMPILERS = ("cc", "gcc", "clang")


class CompilerMissing(ValueError):
    """No C compiler is installed for a platform; the message names the remedies."""


class CompilationFailed(ValueError):
    """The compiler rejected the sources; the message holds the compiler's first error."""


@dataclass(frozen=True)
class Platform:
    """A combination of processor and operating system."""

    name: str  # platform tuple of FMI 3.0
    system_folder: str  # its name in versions of FMI with `system_folders`
    suffix: str  # file name suffix of shared libraries
    zig_target: str  # its name in zig
    flags: tuple[str, ...] = ()  # compiler flags

    def folder(self, fmi_version: int) -> str:
        """Return the folder below binaries/ of an FMU."""
        if DIALECTS[fmi_version].system_folders:
            return self.system_folder
        return self.name


Platforms: TypeAlias = tuple[Platform, ...]
_LINUX = ("-fPIC", "-Wl,--build-id=none", "-s")
# The library's own name and the map of its object files would be paths of the machine that compiles.
_DARWIN = ("-fPIC", "-Wl,-install_name,@rpath/fmu.dylib", "-s")
PLATFORMS = {
    platform.name: platform
    for platform in (
        # glibc 2.17 is that of the oldest supported distributions.
        Platform("x86_64-linux", "linux64", ".so", "x86_64-linux-gnu.2.17", _LINUX),
        Platform("aarch64-linux", "aarch64-linux", ".so", "aarch64-linux-gnu.2.17", _LINUX),
        Platform("x86_64-darwin", "darwin64", ".dylib", "x86_64-macos", _DARWIN),
        Platform("aarch64-darwin", "aarch64-darwin", ".dylib", "aarch64-macos", _DARWIN),
        Platform("x86_64-windows", "win64", ".dll", "x86_64-windows-gnu", ("-s",)),
    )
}


def this_platform() -> Platform:
    """Return the platform of this machine.

    Raises:
        ValueError: FMUs cannot be built for it.
    """
    processor = platform.machine().lower()
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(processor, processor)
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    name = f"{machine}-{system}"
    if name not in PLATFORMS:
        raise ValueError(
            f"this machine is {name!r}, for which no FMU can be built; known are {', '.join(PLATFORMS)}"
        )
    return PLATFORMS[name]


def parse_platforms(text: str | None) -> Platforms:
    """Return the platforms in a comma-separated list; None stands for this machine, "all" for all.

    Raises:
        ValueError: unknown name.
    """
    if text is None:
        return (this_platform(),)
    if text == "all":
        return tuple(PLATFORMS.values())
    names = [name.strip() for name in text.split(",")]
    for name in names:
        if name not in PLATFORMS:
            raise ValueError(
                f"platforms holds {name!r}; known are {', '.join(PLATFORMS)} and 'all'"
            )
    return tuple(PLATFORMS[name] for name in dict.fromkeys(names))


def compile_library(
    folder: Path,
    sources: Sequence[str],
    target: Platform,
    library: Path,
    further: Sequence[str] = (),
) -> None:
    """Compile `sources` in `folder` into the shared library `library`.

    Args:
        folder: folder of the sources and headers; the compiler runs there, so that no path enters the library.
        sources: file names.
        target: platform of the library.
        library: the file to write.
        further: flags, which override the usual ones.

    Raises:
        CompilerMissing: no compiler for this platform is installed.
        CompilationFailed: the compiler rejected the sources.
    """
    library.parent.mkdir(parents=True, exist_ok=True)
    output = library.resolve()
    libraries = () if target.suffix == ".dll" else ("-lm",)
    flags = [*CODE, *target.flags, *further]
    arguments = [*_compiler(target), *flags, *sources, "-o", str(output), *libraries]
    environment = {**os.environ, "SOURCE_DATE_EPOCH": "315532800", "ZERO_AR_DATE": "1"}
    done = subprocess.run(
        arguments,
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
        errors="replace",
    )
    if done.returncode != 0:
        output_lines = done.stderr.splitlines()
        errors = [line for line in output_lines if "error" in line]
        first, *_ = errors or output_lines or ["no message"]
        raise CompilationFailed(f"{arguments[0]} failed for {target.name}: {first}")


def describe_compiler(target: Platform) -> str:
    """Return the first line with which the compiler for a platform introduces itself.

    Raises:
        CompilerMissing: none is installed.
    """
    done = subprocess.run(
        [*_compiler(target), "--version"], capture_output=True, text=True, check=False
    )
    return done.stdout.partition("\n")[0]


def library_files(
    libraries: Mapping[Platform, bytes], identifier: str, fmi_version: int
) -> dict[str, bytes]:
    """Return libraries by their paths in an FMU.

    Importers of FMI 2 look on ARM in the folder of the 64-bit system, which has no word for the processor: for macOS it
    gets a library for both processors, for Linux that of ARM unless there is one of x86-64.
    """
    files = {
        each.folder(fmi_version): (each.suffix, content) for each, content in libraries.items()
    }
    if DIALECTS[fmi_version].system_folders:
        named = {each.name: content for each, content in libraries.items()}
        mac = [named[name] for name in ("x86_64-darwin", "aarch64-darwin") if name in named]
        if mac:
            files["darwin64"] = (".dylib", universal_library(mac))
        if "aarch64-linux" in named:
            files.setdefault("linux64", (".so", named["aarch64-linux"]))
    return {
        f"binaries/{folder}/{identifier}{suffix}": content
        for folder, (suffix, content) in files.items()
    }


def universal_library(slices: Sequence[bytes]) -> bytes:
    """Return one macOS library that holds those of several processors; a single one stays as it is.

    The format is that of `mach-o/fat.h`: a header with processor, offset, size and alignment of each slice, big-endian.
    """
    if len(slices) == 1:
        return slices[0]
    alignment = 14  # [bits], pages of 16 KiB, as Apple's processors have them
    page = 1 << alignment
    header = struct.pack(">II", 0xCAFEBABE, len(slices))
    body = b""
    end = page
    for content in slices:
        processor, variant = struct.unpack_from("<II", content, 4)
        header += struct.pack(">5I", processor, variant, end, len(content), alignment)
        body += content + bytes(-len(content) % page)
        end = page + len(body)
    return header + bytes(page - len(header)) + body


def _words(command: str) -> list[str]:
    """Return the words of a command such as "gcc -m64"; a path with spaces that is a file is one word."""
    try:
        if shutil.which(command):
            return [command]
        return shlex.split(command) or [command]
    except ValueError:  # an unclosed quotation mark
        return [command]


def _compiler(target: Platform) -> list[str]:
    """Return the command that compiles for `target`: the system's compiler for this machine, zig for the others."""
    if target == this_platform():
        named = os.environ.get("CC", "").strip()
        candidates = [_words(named)] if named else [[each] for each in COMPILERS]
        for command, *flags in candidates:
            path = shutil.which(command)
            if path is not None:
                return [path, *flags]
        if named:
            raise CompilerMissing(
                f"{target.name}: CC names {named!r}, which was not found; name another"
            )
    if importlib.util.find_spec("ziglang") is not None:
        return [sys.executable, "-m", "ziglang", "cc", "-target", target.zig_target]
    wanted = "only zig compiles for another machine"
    if target == this_platform():
        wanted = "no C compiler was found"
    raise CompilerMissing(
        f"{target.name}: {wanted}; install gcc or clang (for this machine), or zig with pip install 'servobench[cross]'"
    )
