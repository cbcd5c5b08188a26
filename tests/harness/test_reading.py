"""Code stays open enough to be read: one statement, one fact. Limits are no targets: what needs more may raise them."""

import ast
import re
from pathlib import Path

import pytest

from kit.reading import read, statements

ROOT = Path(__file__).parents[2]
FOLDERS = ("plant", "controllers", "fmus", "harness")
# Mean nodes a statement, % of the statements above 20, % of the functions with a mean above 16
USUAL = (10.3, 7.0, 5.5)
LIMITS = {"controllers": (11.0, 7.0, 6.0)}  # formulas of filters and laws, which stay whole


def files(folder: str) -> list[Path]:
    return sorted((ROOT / folder).rglob("*.py"))


@pytest.fixture(scope="module")
def readings():
    """What is counted in each folder, once for all tests."""
    return {folder: read(files(folder)) for folder in FOLDERS}


@pytest.mark.parametrize("folder", FOLDERS)
def test_a_statement_of_a_folder_holds_one_fact(folder, readings):
    reading = readings[folder]
    mean, dense_statements, dense_functions = LIMITS.get(folder, USUAL)
    assert round(reading.mean, 1) <= mean, densest(reading)
    assert round(reading.dense_statements, 1) <= dense_statements, densest(reading)
    assert round(reading.dense_functions, 1) <= dense_functions, densest(reading)


def test_forms_that_hide_a_decision_or_a_second_fact_stay_rare(readings):
    def count(form):
        return sum(getattr(each, form) for each in readings.values())

    assert count("walruses") == 0
    assert count("texts_times_truth") == 0
    assert count("tuple_assignments") <= 280
    assert count("conditional_expressions") <= 550
    assert count("nounless_comments") <= 30
    assert count("reasons") >= 250


def test_a_name_of_a_test_has_at_most_80_letters():
    texts = [path.read_text(encoding="utf-8") for path in files("tests")]
    names = [name for text in texts for name in re.findall(r"def (test_\w+)", text)]
    assert names
    assert [name for name in names if len(name) > 80] == []


def densest(reading) -> list[str]:
    order = sorted(reading.functions, key=reading.functions.__getitem__, reverse=True)
    return [place.removeprefix(f"{ROOT}/") for place in order[:5]]


@pytest.mark.parametrize(
    ("code", "nodes"),
    [
        ("x = 1", 3),  # the assignment, its target and its value
        ("a, b = f(c), d", 9),
        ("if a < b:\n  pass", 5),
        ("for k in x:\n  '''Nothing.'''", 3),
    ],
)
def test_statements_are_measured_by_the_nodes_of_their_syntax(code, nodes):
    tree = ast.parse("def f():\n  " + code.replace("\n", "\n  "))
    assert list(statements(tree)) == [nodes]


def test_each_form_is_found_and_its_harmless_kin_are_not(tmp_path):
    path = tmp_path / "dense.py"
    path.write_text(
        "def f(a, b, n):\n"
        "    # Because it is so.\n"
        "    x, y = 1, 2  # of the room\n"
        "    a, b = b, a\n"
        "    z = [m := n, m]\n"
        "    if (k := n) > 2:\n"
        "        return 's' * (k > 3)\n"
        "    return k if n else z\n"
    )
    reading = read([path])
    assert reading.tuple_assignments == 1
    assert reading.walruses == 1
    assert reading.texts_times_truth == 1
    assert reading.conditional_expressions == 1
    assert reading.nounless_comments == 1
    assert reading.reasons == 1
