"""C that is generated for a model: functions of CasADi, and the layout header."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import casadi
import numpy as np

from servobench.fmus.variables import FIXED, INPUT, PARAMETER, STATE, Layout
from servobench.plant.contract.checks import FloatArray

# Generated functions do not use all of their parameters; none of them is exported by the library.
HEAD = """/* Generated with CasADi's code generator; not meant to be edited. */
#ifdef __GNUC__
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif
#define CASADI_SYMBOL_EXPORT
#include "{name}.h"
"""


def generated_source(name: str, functions: Iterable[Any]) -> str:
    """Return the file `name`.c with functions of CasADi, which `name`.h declares."""
    generator = casadi.CodeGenerator(f"{name}.c", {"with_header": False, "casadi_int": "int"})
    for function in functions:
        generator.add(function)
    with tempfile.TemporaryDirectory() as folder:
        generator.generate(f"{folder}/")
        return HEAD.format(name=name) + (Path(folder) / f"{name}.c").read_text(encoding="utf-8")


def layout_header(
    layout: Layout,
    start: Mapping[str, FloatArray],
    constants: Mapping[str, float],
    model_name: str,
    token: str,
) -> str:
    """Return the C header with sizes, offsets, start values and minima.

    Args:
        layout: groups of the model.
        start: start values, flat arrays by group; zero where there are none.
        constants: further ones by name.
        model_name: for log messages.
        token: GUID that the importer passes to `fmi2Instantiate` or `fmi3Instantiate…`.
    """
    settable = layout.of_role(PARAMETER, FIXED, INPUT, STATE)
    lines = [
        "/* Generated from the table of variables; not meant to be edited. */",
        "#ifndef LAYOUT_H",
        "#define LAYOUT_H",
    ]
    lines += [f'#define MODEL_NAME "{model_name}"', f'#define TOKEN "{token}"']
    lines += [f"#define N_GROUPS {len(layout.groups)}", f"#define N_VALUES {layout.size}"]
    lines += [f"#define N_SETTABLE {sum(group.size for group in settable)}"]
    lines += [f"#define OFFSET_{_macro(group.name)} {layout.offsets[group.name]}" for group in layout.groups]
    lines += [f"#define {name} {value!r}" for name, value in constants.items()]
    sizes = ", ".join(f"{{{layout.offsets[group.name]}, {group.size}}}" for group in layout.groups)
    zero = np.zeros(1)
    values = np.concatenate([np.resize(start.get(group.name, zero), group.size) for group in layout.groups])
    minima = [bound for group in settable for bound in [_bound(group.minimum)] * group.size]
    lines += [f"#define GROUPS {{{sizes}}}"]
    lines += [_initialiser("START_VALUES", [float(value).hex() for value in values])]
    lines += [_initialiser("MINIMA", minima), "#endif", ""]
    return "\n".join(lines)


def _macro(name: str) -> str:
    return name.upper().replace("DER(", "DER_").replace(")", "")


def _bound(minimum: float | None) -> str:
    return "-HUGE_VAL" if minimum is None else float(minimum).hex()


def _initialiser(name: str, values: list[str]) -> str:
    return f"#define {name} {{ \\\n    " + ", \\\n    ".join(values) + "}"
