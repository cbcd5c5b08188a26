"""Imports point one way: harness -> controllers -> servobench.plant.signals; harness -> plant; fmus -> plant."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("plant", "controllers", "fmus", "harness")
MAY_IMPORT = {
    "plant": ("plant",),
    "controllers": ("controllers", "plant.signals", "plant.checks", "plant.faults", "plant.settings"),
    "fmus": ("fmus", "plant"),
    "harness": PACKAGES,
}
OWNERS = {
    "pybullet": ("plant/bullet/scene",),
    "casadi": ("plant/robot/symbolic", "plant/fmu/model_exchange", "controllers/laws/mpc", "controllers/nmpc", "fmus/"),
    "fmpy": ("plant/fmu", "fmus/"),
    "dask": ("harness/batch/cluster",),
    "distributed": ("harness/batch/cluster",),
    "optuna": ("harness/studies/tuning/",),
    "statsmodels": ("harness/analysis/statistics",),
}


def imports(path: Path) -> list[str]:
    found = []
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            found += [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            found.append(node.module or "")
    return found


SOURCES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]


def starts_with(name: str, prefix: str) -> bool:
    return name == prefix or name.startswith(prefix + ".")


@pytest.mark.parametrize("path", SOURCES, ids=[str(path.relative_to(ROOT)) for path in SOURCES])
def test_a_module_imports_only_what_lies_below_it_and_what_it_owns(path):
    relative = path.relative_to(ROOT).as_posix()
    package = relative.split("/")[0]
    for name in imports(path):
        if name.startswith("servobench."):
            inner = name.removeprefix("servobench.")
            assert any(starts_with(inner, allowed) for allowed in MAY_IMPORT[package]), f"{relative} imports {name}"
        for library, owners in OWNERS.items():
            if starts_with(name, library):
                assert any(relative.startswith(owner) for owner in owners), f"{relative} imports {name}"
