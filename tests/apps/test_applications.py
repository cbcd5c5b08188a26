"""The table of applications says what is there: rooms, commands, extras and the contract of imports."""

import tomllib

import pytest

from kit.command import python
from kit.documents import ROOT
from servobench.harness.cli.applications import APPLICATIONS, CORE, PANELS, find_command, home_of

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_each_room_is_a_row_and_each_row_a_room():
    rooms = {path.parent.name for path in (ROOT / "harness" / "apps").glob("*/__init__.py")}
    assert rooms == {name for name, row in APPLICATIONS.items() if not row.package}


def test_the_help_page_has_every_command_once():
    listed = [name for names in PANELS.values() for name in names]
    declared = [name for names in CORE.values() for name in names]
    declared += [name for row in APPLICATIONS.values() for name in row.commands]
    assert sorted(listed) == sorted(declared)
    assert len(set(listed)) == len(listed)


def test_extras_are_those_of_the_project():
    offered = PROJECT["project"]["optional-dependencies"]
    assert {row.extra for row in APPLICATIONS.values()} - {""} <= set(offered)


def test_a_contract_forbids_the_core_to_import_an_application():
    layers = {
        place: each["layers"]
        for each in PROJECT["tool"]["importlinter"]["contracts"]
        if each["type"] == "layers"
        for place in each["containers"]
    }
    elsewhere = [row.package.rpartition(".")[2] for row in APPLICATIONS.values() if row.package]
    assert set(layers["servobench.harness"][0].split(" | ")) == {"apps", *elsewhere}
    known = {name for layer in layers["servobench.harness.apps"] for name in layer.split(" | ")}
    assert known == {name for name, row in APPLICATIONS.items() if not row.package}
    further = [each for row in APPLICATIONS.values() for each in row.further]
    assert further == ["servobench.fmus." + layers["servobench.fmus"][0]]


@pytest.mark.parametrize("name", ["plants", "fmu", "identify"])
def test_a_command_loads_no_application_but_its_own(name):
    code = (
        "import sys; from servobench.harness.cli.main import command_line; "
        f"command_line({name!r}); "
        "print(*sorted({each.split('.')[3] for each in sys.modules if 'harness.apps.' in each}))"
    )
    said = python("-c", code)
    own = [each for each, row in APPLICATIONS.items() if name in row.commands]
    assert said.stdout.split() == own


def test_a_command_is_found_in_its_room():
    assert home_of("suite") == "servobench.harness.apps.studies.commands"
    assert find_command("collect").__module__ == "servobench.harness.cli.results"
