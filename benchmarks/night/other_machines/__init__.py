"""Exported FMUs on other processors and systems: a driver in C runs their libraries under qemu and wine."""

from __future__ import annotations

import importlib.util
import os
import shutil
import sys
import zipfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from kit.command import carried_out
from servobench.fmus.compiler import PLATFORMS, Platform, this_platform
from servobench.fmus.product import Product

HERE = Path(__file__).parent
ARM_LIBRARIES = os.environ.get("QEMU_LD_PREFIX", "/usr/aarch64-linux-gnu")


@dataclass(frozen=True)
class Machine:
    """Another machine, as this one imitates it.

    Attributes:
        platform: that libraries are compiled for.
        command: runs a program of it.
        lacking: what to install where it cannot be imitated; empty if it can.
    """

    platform: Platform
    command: tuple[str, ...]
    lacking: str

    @property
    def name(self) -> str:
        """Name of the platform."""
        return self.platform.name


def machines() -> tuple[Machine, ...]:
    """Return 64-bit ARM under Linux by qemu, and Windows by wine."""
    zig = "" if importlib.util.find_spec("ziglang") else "zig, pip install ziglang"
    qemu, wine = shutil.which("qemu-aarch64"), shutil.which("wine64") or shutil.which("wine")
    loader = Path(ARM_LIBRARIES, "lib", "ld-linux-aarch64.so.1").exists()
    arm = (
        ""
        if qemu and loader
        else "qemu-aarch64 and the C library of ARM, apt install qemu-user libc6-arm64-cross"
    )
    windows = "" if wine else "wine, apt install wine64"
    return (
        Machine(PLATFORMS["aarch64-linux"], (qemu or "", "-L", ARM_LIBRARIES), zig or arm),
        Machine(PLATFORMS["x86_64-windows"], (wine or "",), zig or windows),
    )


def unpack(made: Product, platforms: tuple[Platform, ...], folder: Path) -> Path:
    """Write an FMU for some platforms and unpack it; return the folder with its sources and libraries."""
    made.write(folder / "it.fmu", platforms)
    with zipfile.ZipFile(folder / "it.fmu") as archive:
        archive.extractall(folder / "it")
    return folder / "it"


def drive(
    unpacked: Path,
    made: Product,
    machine: Machine | None,
    inputs: np.ndarray,
    *,
    first: int = 0,
    step: float,
    home: Path | None = None,
) -> np.ndarray:
    """Return all values of an FMU after each step, (steps, values), on another machine, or on this one for None.

    Args:
        unpacked: from `unpack`.
        made: what it was written from.
        machine: the other one.
        inputs: (steps, k), held over each step.
        first: offset of the inputs among the values.
        step: s.
        home: folder in which wine keeps its settings.

    Raises:
        AssertionError: the driver was not compiled or said that something failed.
    """
    platform, command = (
        (this_platform(), ()) if machine is None else (machine.platform, machine.command)
    )
    identifier, version = made.description.model_identifier, made.fmi_version
    library = unpacked / "binaries" / platform.folder(version) / f"{identifier}{platform.suffix}"
    program = unpacked / f"drive-{platform.name}.exe"
    build = [shutil.which("cc")] if machine is None else [sys.executable, "-m", "ziglang", "cc"]
    target = [] if machine is None else ["-target", platform.zig_target]
    system = [] if platform.suffix == ".dll" else ["-ldl"]
    options = [
        f"-DFMI_VERSION={version}",
        "-I",
        str(unpacked / "sources"),
        "-O2",
        "-o",
        str(program),
    ]
    done = carried_out(*build, *target, HERE / "drive.c", *options, *system)
    assert done.returncode == 0, done.stderr[:2000]
    head = np.array([step, first, inputs.shape[1]])
    (unpacked / "inputs").write_bytes(
        np.concatenate([head, np.ravel(inputs)]).astype("<f8").tobytes()
    )
    environment = {
        **os.environ,
        "WINEPREFIX": str(home or unpacked),
        "WINEDEBUG": "-all",
        "DISPLAY": "",
    }
    words = [
        *command,
        f"./{program.name}",
        f"./{library.relative_to(unpacked).as_posix()}",
        "inputs",
        "outputs",
    ]
    done = carried_out(*words, cwd=unpacked, env=environment, timeout=600, errors="replace")
    assert done.returncode == 0, f"{words}: exit code {done.returncode}: {done.stderr[:2000]}"
    return np.frombuffer((unpacked / "outputs").read_bytes(), "<f8").reshape(len(inputs), -1)
