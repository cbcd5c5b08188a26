"""The names of each version of FMI against the standard's own headers and schemas, which fmpy brings."""

from importlib.resources import files

import pytest

from servobench.fmus.dialect import EXPORTS, export_dialect
from servobench.plant.fmu.dialect import DIALECTS, FMI2
from servobench.plant.fmu.instances import INSTANCES

EVERY = pytest.mark.parametrize("dialect", EXPORTS.values(), ids=lambda each: each.names.prefix)


def headers(dialect):
    folder = files("fmpy") / "c-code"
    return "\n".join((folder / name).read_text(encoding="utf-8") for name in dialect.headers)


def schema(dialect):
    folder = files("fmpy") / "schema" / dialect.names.prefix
    return "\n".join(file.read_text(encoding="utf-8") for file in folder.iterdir())


@EVERY
def test_headers_declare_every_function_that_a_dialect_names(dialect):
    names = dialect.names
    words = {word for word, _ in names.kinds.values()}
    functions = {f"{verb}{word}" for verb in ("Get", "Set") for word in (*words, names.state)}
    functions |= {names.derivatives, f"{names.deserialise}{names.state}"}
    functions |= {f"Free{names.state}", f"Serialize{names.state}", f"Serialized{names.state}Size"}
    declared = headers(dialect)
    for function in functions:
        assert f"{names.prefix}{function}" in declared


@EVERY
def test_schemas_hold_every_attribute_and_element_that_a_dialect_names(dialect):
    words = [dialect.names.token, *dialect.sections.values(), *dialect.exchange]
    words += [*dialect.capabilities, *dialect.differentiation]
    if dialect.indicator_count is not None:
        words.append(dialect.indicator_count)
    described = schema(dialect)
    for word in words:
        assert f'name="{word}"' in described


def test_every_version_has_a_dialect_on_either_side_and_an_instance():
    assert set(DIALECTS) == set(EXPORTS) == set(INSTANCES)
    for version, dialect in DIALECTS.items():
        assert EXPORTS[version].names is dialect
        assert INSTANCES[version].dialect is dialect


def test_names_of_fmi_2_are_those_of_the_standard():
    assert export_dialect(2).names is FMI2
    assert (FMI2.token, FMI2.real, FMI2.state) == ("guid", "Real", "FMUstate")
