"""TOML of users: bombs are refused before they are parsed, and texts may hold as many dots as they like."""

import time

import pytest

from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import MAX_KEY, MAX_KEY_PARTS, parse_toml, read_toml

MANY = 100_000
PARTS = ["a"] * MANY
BOMBS = {
    "a key": ".".join(PARTS) + " = 1",
    "a key with blanks": " .\t".join(PARTS) + " = 1",
    "a key of quoted parts": ".".join(['"a.b"'] * MANY) + " = 1",
    "a key of literal parts": ".".join(["'a'"] * MANY) + " = 1",
    "a key without a value": ".".join(PARTS),
    "a key in an inline table": "b = {" + ".".join(PARTS) + " = 1}",
    "a header": "[" + ".".join(PARTS) + "]",
    "a header of an array": "[[ " + " . ".join(PARTS) + " ]]",
    "a key behind a text": "b = '''\n''' # '\n" + ".".join(PARTS) + " = 1",
}
TEXTS = {
    "of several lines": ('a = """\n' + "b.c." * MANY + '\\" " ""\n"""', "b.c." * MANY + '" " ""\n'),
    "literal, of several lines": ("a = '''" + "b." * MANY + "''''", "b." * MANY + "'"),
    "of one line": ('a = "' + "b." * MANY + '\\""', "b." * MANY + '"'),
    "literal": ("a = '" + "b." * MANY + "' # " + "c." * MANY, "b." * MANY),
}


@pytest.mark.parametrize("kind", BOMBS)
def test_a_key_of_many_parts_is_refused_at_once(kind, tmp_path):
    (tmp_path / "bomb.toml").write_text(BOMBS[kind])
    began = time.process_time()
    with pytest.raises(
        ConfigurationError,
        match=f"^robot file .* the key .* has more than {MAX_KEY_PARTS} parts; nest no",
    ):
        read_toml("robot file", tmp_path / "bomb.toml")
    assert time.process_time() - began < 2.0


@pytest.mark.parametrize("line", ["k{}.b = 1", "[k{}]", "k{} = 1", "[[k{}.c]]"])
def test_many_short_lines_are_refused_at_once(line):
    with pytest.raises(
        ValueError, match="letters beside texts and comments; at most 500000 are read"
    ):
        parse_toml("\n".join(map(line.format, range(MANY))))


@pytest.mark.parametrize(
    "where", ['"{}" = 1', "'{}'.b = 1", '["{}"]', 'a = [{{b = {{"{}" = 1}}}}]']
)
def test_a_long_key_in_quotes_is_refused(where):
    parse_toml(where.format("k" * MAX_KEY))
    with pytest.raises(
        ValueError,
        match=f"the key kkkkkkkkkkkkkkkkkkkk… has {MAX_KEY + 1} letters; at most {MAX_KEY} are",
    ):
        parse_toml(where.format("k" * (MAX_KEY + 1)))


@pytest.mark.parametrize("nested", ["[" * MANY + "]" * MANY, "{b=" * MANY + "1" + "}" * MANY])
def test_what_is_nested_too_deeply_is_refused(nested, tmp_path):
    (tmp_path / "deep.toml").write_text(f"a = {nested}")
    with pytest.raises(ConfigurationError, match=r"deep\.toml is not valid TOML"):
        read_toml("mapping", tmp_path / "deep.toml")


@pytest.mark.parametrize("kind", TEXTS)
def test_a_text_may_hold_many_dots(kind):
    text, value = TEXTS[kind]
    assert parse_toml(text) == {"a": value}


def test_quoted_keys_may_hold_dots_and_numbers_stand_side_by_side():
    numbers = ", ".join(["0.5"] * 1000)
    name = "arm.joint." * 100
    found = parse_toml(f'"{name}" = [{numbers}]\nb.c."d.e" = 1979-05-27T07:32:00.999\n[x.y]\n')
    assert found[name] == [0.5] * 1000
    assert list(found["b"]["c"]) == ["d.e"]
    assert found["x"] == {"y": {}}
