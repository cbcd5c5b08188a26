"""MuJoCo, and OpenGL contexts without a window, in which it renders.

    from servobench.plant.rendered.mujoco.engine import mujoco

MuJoCo brings no renderer: it takes the OpenGL of the machine, through EGL or OSMesa on Linux, both of which also run on
the processor alone. The environment variable MUJOCO_GL chooses between them, as everywhere with MuJoCo.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from importlib.metadata import version
from typing import Any, Final

import mujoco

if mujoco.get_mju_user_warning() is None:
    # MuJoCo would write warnings into a file MUJOCO_LOG.TXT of the current folder; what is wrong shows in the joints.
    mujoco.set_mju_user_warning(lambda _: None)

LIBRARIES: Final = {"egl": "libEGL.so.1", "osmesa": "libOSMesa.so.8"}  # on Linux, the first choice first
ELSEWHERE: Final = {"darwin": "cgl", "win32": "glfw"}  # what other systems bring
INSTALL: Final = "install OpenGL for EGL (Debian and Ubuntu: apt install libegl1 libgl1-mesa-dri)"


def renderer_name() -> str:
    """Return by what MuJoCo gets at OpenGL: the word of MUJOCO_GL, or else the first one that this machine has.

    Raises:
        ValueError: the machine has none.
    """
    chosen = os.environ.get("MUJOCO_GL", "").strip().lower()
    if chosen:
        return chosen
    if not sys.platform.startswith("linux"):
        return ELSEWHERE[sys.platform]
    for name, library in LIBRARIES.items():
        try:
            ctypes.CDLL(library)
        except OSError:
            continue
        return name
    raise ValueError(f"MuJoCo has nothing to render with, neither EGL nor OSMesa: {INSTALL}")


def open_context(width: int, height: int) -> Any:  # noqa: ANN401 - of the class that belongs to the renderer
    """Return an OpenGL context for images of up to width × height [px]; it is current within `as_current()`.

    Raises:
        ValueError: the machine cannot render; says what to install.
    """
    name = renderer_name()
    try:
        context = import_module(f"mujoco.{name}").GLContext(width, height)
        with context.as_current():
            return context
    except Exception as error:  # what is missing shows in many ways, by library and by driver
        why = " ".join(str(error).split())
        raise ValueError(f"MuJoCo cannot render through {name} ({type(error).__name__}: {why}): {INSTALL}") from error


@contextmanager
def scissors(left: int, bottom: int, width: int, height: int) -> Iterator[None]:
    """Let OpenGL fill no pixel of the current context outside of a rectangle, counted from the lower left corner."""
    from OpenGL import GL  # noqa: PLC0415 - chooses its platform by what `open_context` has loaded

    GL.glEnable(GL.GL_SCISSOR_TEST)
    GL.glScissor(left, bottom, width, height)
    try:
        yield
    finally:
        GL.glDisable(GL.GL_SCISSOR_TEST)


@cache
def missing_renderer() -> str:
    """Return a line about what this machine lacks for images; empty if nothing."""
    try:
        open_context(16, 16).free()
    except ValueError as error:
        return str(error)
    return ""


@cache
def describe_renderer() -> str:
    """Return which engine computes, and what renders its images."""
    from OpenGL import GL  # noqa: PLC0415 - as above

    if missing_renderer():
        return f"MuJoCo {version('mujoco')}, nothing to render with"
    context = open_context(16, 16)
    with context.as_current():
        renderer = GL.glGetString(GL.GL_RENDERER).decode()
    context.free()
    return f"MuJoCo {version('mujoco')}, rendered by {renderer} through {renderer_name().upper()}"


__all__ = ["describe_renderer", "missing_renderer", "mujoco", "open_context", "renderer_name", "scissors"]
