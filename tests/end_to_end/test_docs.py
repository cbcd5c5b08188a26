"""The pages of documentation: their links, the code that they name, and the examples that they promise to run."""

import ast
import importlib
import json
import re
import subprocess
import sys
import tempfile
import tomllib
from pathlib import Path

import pytest
from typer.testing import CliRunner

import generated_tables
from kit import console
from kit.browser import browser_page, find_browser
from kit.documents import (
    DOCS,
    PAGES,
    PLACE,
    ROOT,
    anchors,
    blocks,
    find,
    names,
    read,
    section,
    tables,
)
from kit.foreign_fmu import build_crane
from kit.nightly import NIGHTLY
from kit.own import install
from servobench.controllers.methods import ESTIMATORS, LAWS
from servobench.harness.cli.applications import assemble
from servobench.harness.cli.main import servobench as first_options
from servobench.harness.config import registry
from servobench.harness.config.settings import read_settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.request import RunRequest
from servobench.harness.run.tasks import TASKS

GLOSSARY = sorted(anchors(section(read("concepts.md"), "Glossary")))
NOTEBOOK = ROOT / "docs" / "worked_example.ipynb"
PLACES = sorted(
    {match.groups() for page in DOCS for match in PLACE.finditer(page.read_text(encoding="utf-8"))}
)


def links(text):
    targets = re.findall(r"\]\(([^)\s]+)\)", text)
    return [target for target in targets if "://" not in target]


@pytest.mark.parametrize("page", PAGES, ids=[str(page.relative_to(ROOT)) for page in PAGES])
def test_every_relative_link_leads_somewhere(page):
    text = page.read_text(encoding="utf-8")
    for link in links(text):
        path, _, anchor = link.partition("#")
        target = page.parent / path if path else page
        assert target.exists(), f"{page.name} links to {link}"
        if anchor:
            assert anchor in anchors(target.read_text(encoding="utf-8")), (
                f"{page.name} links to {link}"
            )


def test_the_pages_do_link():
    assert {"docs/five_minutes.md", "docs/limitations.md", "docs/results.md"} <= set(
        links(PAGES[0].read_text(encoding="utf-8"))
    )
    assert sum(len(links(page.read_text(encoding="utf-8"))) for page in DOCS) > 30


def test_what_the_readme_says_that_its_command_prints_is_what_it_prints(
    no_figures, monkeypatch, capsys, tmp_path
):
    sessions = [
        page
        for page in PAGES
        if "```console\n" in page.read_text(encoding="utf-8") and page not in DOCS
    ]
    assert sessions == [PAGES[0]]  # test_first_hour.py carries those of the site out
    assert (
        console.carry_out(PAGES[0].read_text(encoding="utf-8"), monkeypatch, capsys, tmp_path) == 1
    )


def test_another_output_than_that_of_the_page_is_found():
    told, printed = (
        console.plain(" a 1 5\n...\n c 3 99\n"),
        console.plain(" a 1 7\n b 5\n c 3 7*\n"),
    )
    console.compare("it", told, printed)
    with pytest.raises(AssertionError, match="does not print 'c 4'"):
        console.compare("it", console.plain(" a 1 2\n...\n c 4 99\n"), printed)
    with pytest.raises(AssertionError, match="also prints"):
        console.compare("it", told[:1], printed)


@pytest.mark.parametrize(("path", "name"), PLACES, ids=[f"{path}:{name}" for path, name in PLACES])
def test_every_piece_of_code_that_is_named_exists(path, name):
    assert find(path, name) is not None


def first_column(page, heading):
    return {
        name
        for _, header, rows in tables(read(page))
        if header[0] == heading
        for row in rows
        for name in names(row[0])
    }


def test_everything_registered_has_a_row_and_nothing_else_has():
    assert first_column("methods.md", "controller") == set(registry.CONTROLLERS)
    assert first_column("plants.md", "plant") == {*registry.PLANTS, "fmu:PATH.toml"}
    assert first_column("tasks.md", "task") == set(TASKS)
    assert set(LAWS) | set(ESTIMATORS) <= set(names(read("methods_reference.md")))


@pytest.fixture
def installed(tmp_path, monkeypatch):
    """Installs the example of a page as pip would: its module and its entry points on the path."""

    def install_example(toml, code):
        project = tomllib.loads(toml)["project"]
        module = project["name"].replace("-", "_")
        points = [
            f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in entries.items())
            for group, entries in project["entry-points"].items()
        ]
        monkeypatch.syspath_prepend(install(tmp_path, module, code, "".join(points)))
        importlib.invalidate_caches()
        forget()
        modules.append(module)

    def forget():
        registry._published.cache_clear()
        registry._points.cache_clear()
        registry._load.cache_clear()

    modules = []
    yield install_example
    monkeypatch.undo()
    forget()
    for module in modules:
        sys.modules.pop(module, None)


@pytest.mark.parametrize("controller", ["nominal_rate", "nominal_broyden"])
def test_the_controllers_of_the_example_settle_on_a_real_plant(installed, controller):
    installed(
        read("examples/nominal-rate/pyproject.toml"), read("examples/nominal-rate/nominal_rate.py")
    )
    assert controller in registry.controller_names()
    request = RunRequest("kinematic", controller, "exp2", "moderate", 3)
    settings = read_settings(
        None, ["nominal_rate.gain=1.5", "nominal_broyden.law.proportional_gain=1.5"]
    )
    row = run_experiment(request, settings).row
    assert row["status"] == "completed"
    assert row["settling_time_s"] < 6.0
    assert 0.0 < row["jacobian_error_mean"] < 1.0


def test_the_plant_of_the_example_closes_a_loop(installed):
    installed(read("examples/planar/pyproject.toml"), read("examples/planar/planar.py"))
    settings = read_settings(None, ["rls.initial.source=probe", "target.target=[0.2, 0.7]"])
    row = run_experiment(RunRequest("planar", "rls", "target", "none", 0), settings).row
    assert row["status"] == "completed"
    assert row["settling_time_s"] < 8.0
    assert row["jacobian_error_mean"] < 0.5


def test_the_mapping_of_the_example_closes_a_loop_on_an_fmu(tmp_path):
    build_crane(tmp_path / "crane.fmu", 3)
    mapping = tmp_path / "crane.toml"
    mapping.write_text(blocks(section(read("fmu.md"), "Every key of the mapping"), "toml")[0])
    plant = f"fmu:{mapping}"
    settings = read_settings(
        None,
        [
            "ukf_mfac.initial.source=probe",
            "target.target=[0.2, 0.7]",
            f"{plant}.sensing.feature_noise=0.0",
        ],
    )
    result = run_experiment(RunRequest(plant, "ukf_mfac", "target", "none", 0), settings)
    assert result.row["settling_time_s"] < 8.0
    assert (result.steps["feature_x_m"] == result.steps["true_feature_x_m"]).all()
    assert "joint_position_luff_rad" in result.steps


def overhangs(places: list[Path], width: int) -> list[int]:
    """Return by how many pixels a table of each page is wider than its room in a window of some width, at most."""
    over = "Math.max(...[...document.querySelectorAll('.table-wrapper')].map(t => t.scrollWidth - t.clientWidth))"
    with tempfile.TemporaryDirectory() as profile, browser_page(Path(profile)) as page:
        page.call(
            "Emulation.setDeviceMetricsOverride",
            width=width,
            height=1000,
            deviceScaleFactor=1,
            mobile=False,
        )
        return [page.open(place) or int(page.evaluate(over)) for place in places]


def test_the_site_is_built_without_a_warning_and_has_every_page(tmp_path):
    pytest.importorskip("sphinx", reason="the extra docs is not installed")
    command = [
        sys.executable,
        "-m",
        "sphinx",
        "--fail-on-warning",
        "--keep-going",
        "--quiet",
        "-b",
        "html",
    ]
    done = subprocess.run(
        [*command, str(ROOT / "docs"), str(tmp_path)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    index = (tmp_path / "index.html").read_text(encoding="utf-8")
    places = [
        page.with_suffix(".html").name for page in (*DOCS, ROOT / "docs" / "worked_example.ipynb")
    ]
    assert [place for place in places if f'href="{place}"' not in index] == ["index.html"]
    shown = re.sub(
        r"<[^>]*>", "", index[index.index("<article") :].replace("<table", "TABLE <table")
    )
    order = (
        "make run",
        "servobench run --plant",
        "TABLE",
        "Four doors",
        "How to",
        "Reference",
        "Explanation",
    )
    places = [shown.index(word) for word in order]
    assert places == sorted(places)
    if find_browser() is not None:
        assert (
            max(
                overhangs(
                    [
                        tmp_path / f"{name}.html"
                        for name in ("index", "methods_reference", "settings")
                    ],
                    1024,
                )
            )
            <= 0
        )
    loaded = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="([^"]*)"', index)
    assert loaded
    assert [place for place in loaded if "//" in place] == []  # it opens without a network
    api = (tmp_path / "api.html").read_text(encoding="utf-8")
    api = re.sub(r"<[^>]*>", "", api)
    assert all(
        words in api
        for words in (
            "run(controller",
            "compare(controllers",
            "load(folder)",
            "step(observation",
            "estimated_jacobian()",
        )
    )


def test_the_lines_that_load_results_run(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    made = CliRunner().invoke(
        assemble("run", first_options),
        ["run", "--plant", "kinematic", "--set", "exp2.duration=0.2", "--no-figures"],
    )
    assert made.exit_code == 0, made.output
    (tmp_path / "first").symlink_to("results/latest")
    for code in blocks(read("results.md"), "python"):
        exec(compile(code, "docs/results.md", "exec"), {})
    printed = capsys.readouterr().out
    assert "ukf_mfac" in printed
    assert "completed" in printed


@pytest.mark.parametrize("name", ["README.md", "docs/five_minutes.md"])
def test_words_of_the_field_are_linked_to_the_glossary_where_they_first_appear(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    linked = {anchor for anchor in GLOSSARY if f"concepts.md#{anchor})" in text}
    assert len(GLOSSARY) >= 15
    assert {"aid", "exp1-to-exp4", "feature", "mismatch", "ukf"} <= linked
    for anchor in linked:
        first = re.search(rf"\[`?([^]`]*)`?\]\((?:docs/)?concepts\.md#{anchor}\)", text)
        before = re.sub(
            r"^[|#!].*", "", console.FENCED.sub("", text[: first.start()]), flags=re.MULTILINE
        )
        assert not re.search(rf"(?<![\w/-]){re.escape(first[1])}(?!\w)", before), (
            f"{first[1]} stands before its link"
        )


def test_pages_install_from_the_clone_until_one_word_says_that_a_release_is_out(monkeypatch):
    pages = {page.relative_to(ROOT).as_posix(): page.read_text(encoding="utf-8") for page in PAGES}
    assert [
        name for name, text in pages.items() if re.search(r"pip install '?servobench", text)
    ] == []
    shown = {name for name, text in pages.items() if "pip install './servobench" in text}
    assert shown == {"README.md", "docs/five_minutes.md", "docs/installation.md"}
    monkeypatch.setattr(generated_tables, "RELEASED", True)
    renewed = {name: generated_tables.renewed(ROOT / name) for name in pages}
    assert "    pip install 'servobench'\n" in renewed["README.md"]
    assert "    pip install 'servobench[report]'\n" in renewed["docs/five_minutes.md"]
    assert [name for name, text in renewed.items() if "./servobench" in text] == []


def test_the_worked_example_is_stored_with_small_outputs():
    cells = json.loads(NOTEBOOK.read_text(encoding="utf-8"))["cells"]
    assert all(cell["outputs"] for cell in cells if cell["cell_type"] == "code")
    assert NOTEBOOK.stat().st_size < 200e3


@pytest.mark.skipif(not NIGHTLY, reason="makes all runs of the worked example: make nightly")
def test_the_outputs_of_the_worked_example_come_out_again():
    command = [sys.executable, str(ROOT / "docs" / "stored_notebook.py"), "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_python_block_is_valid_python():
    codes = [code for page in DOCS for code in blocks(page.read_text(encoding="utf-8"), "python")]
    assert codes
    assert all(ast.parse(code).body for code in codes)


def test_the_table_of_equations_has_each_once_and_the_code_names_it_too():
    def numbers(text):
        found = []
        for first, last in re.findall(r"(\d+)(?:[–-](\d+))?", text):
            found += range(int(first), int(last or first) + 1)
        return found

    rows = next(
        rows for _, header, rows in tables(read("methods_reference.md")) if header[0] == "equation"
    )
    assert sorted(number for row in rows for number in numbers(row[0])) == list(range(1, 47))
    for equations, where in rows:
        for path, _ in PLACE.findall(where):
            text = (ROOT / path).read_text(encoding="utf-8")
            told = {
                n for found in re.findall(r"eqs?\. ([\d–\-, and]+)", text) for n in numbers(found)
            }
            if not path.startswith("tests/"):
                assert told >= set(numbers(equations)), (
                    f"{path} does not name all of eqs. {equations}"
                )
