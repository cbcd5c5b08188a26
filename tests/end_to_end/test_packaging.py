"""What is installed: one package, with everything in it that is read at run time."""

import json
import os
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from kit.command import carried_out
from servobench.harness.config.installation import read_checkout, short_commit, version_line

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / ".ci"))
import release  # noqa: E402 - a script beside the package

FOLDERS = ("plant", "controllers", "fmus", "harness")
CODE = (".py", ".toml", ".c", ".h", ".j2", ".urdf", ".yaml", ".csv")


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """Wheel and source distribution."""
    return release.build(tmp_path_factory.mktemp("dist"))


@pytest.fixture(scope="module")
def wheel_names(files):
    with zipfile.ZipFile(files[0]) as wheel:
        return set(wheel.namelist())


def test_the_wheel_holds_one_package_with_its_types(wheel_names):
    assert {name.split("/")[0].split("-")[0] for name in wheel_names} == {"servobench"}
    assert {
        "servobench/py.typed",
        "servobench/__main__.py",
        "servobench/plant/contract/signals.py",
    } <= wheel_names
    assert {
        name.split("/")[1]
        for name in wheel_names
        if name.startswith("servobench/") and name.count("/") > 1
    } == {*FOLDERS}


def test_the_wheel_holds_every_file_that_the_package_reads(wheel_names):
    wanted = {
        f"servobench/{path.relative_to(ROOT).as_posix()}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in CODE
    }
    assert wanted <= wheel_names
    assert "servobench/harness/notebooks/analysis.ipynb" in wheel_names


def test_the_source_distribution_makes_the_same_wheel(files, wheel_names, tmp_path):
    with tarfile.open(files[1]) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    command = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(command, cwd=source, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        assert set(wheel.namelist()) == wheel_names


def test_a_wheel_of_a_clone_knows_its_commit_when_it_is_installed(files, tmp_path):
    commit, _ = read_checkout()
    with zipfile.ZipFile(files[0]) as wheel:
        wheel.extractall(tmp_path)
    command = [sys.executable, "-P", "-m", "servobench", "--version"]
    installed = {**os.environ, "PYTHONPATH": str(tmp_path)}
    made = carried_out(*command, cwd=tmp_path, env=installed)
    assert (tmp_path / "servobench" / "commit.txt").read_text() == commit
    assert made.stdout.strip() == version_line()
    assert short_commit(commit) in made.stdout


def test_the_files_of_a_release_have_no_faults(files):
    wheel, source = files
    assert release.faults_of_wheel(wheel) == release.faults_of_source(source) == []
    assert release.faults_of_versions(wheel, ROOT) == []


def test_a_wheel_that_lacks_a_file_or_holds_others_is_refused(files, tmp_path):
    broken = tmp_path / files[0].name
    with zipfile.ZipFile(files[0]) as wheel, zipfile.ZipFile(broken, "w") as made:
        for name in wheel.namelist():
            if name != "servobench/py.typed":
                made.writestr(name, wheel.read(name).replace(b"text/markdown", b"text/plain"))
        made.writestr("plant/contract/signals.py", "")
        made.writestr("servobench/tests/test_it.py", "")
    assert release.faults_of_wheel(broken) == [
        f"{broken.name} lacks servobench/py.typed",
        f"{broken.name} holds servobench/tests/test_it.py",
        f"{broken.name} installs plant, servobench, wanted servobench alone",
        f"{broken.name} does not say that its description is Markdown",
    ]


def test_a_source_distribution_without_tests_is_refused(files, tmp_path):
    broken = tmp_path / "bare.tar.gz"
    with tarfile.open(files[1]) as source, tarfile.open(broken, "w:gz") as made:
        for member in source.getmembers():
            if "/tests" not in member.name:
                made.addfile(member, source.extractfile(member) if member.isfile() else None)
    assert release.faults_of_source(broken) == ["bare.tar.gz lacks tests/conftest.py"]


def test_another_version_in_the_citation_is_told(files, tmp_path):
    for name in ("pyproject.toml", "CITATION.cff"):
        (tmp_path / name).write_text(
            (ROOT / name).read_text(encoding="utf-8").replace("\nversion: ", "\nversion: 9.")
        )
    (fault,) = release.faults_of_versions(files[0], tmp_path)
    assert fault.startswith("CITATION.cff says version 9.")


def test_only_the_tagged_commit_of_a_version_without_changes_is_a_release(tmp_path):
    def git(*words):
        subprocess.run(
            ["git", "-c", "user.name=A", "-c", "user.email=a@b.c", *words], cwd=tmp_path, check=True
        )

    git("init", "--quiet")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## Unreleased\n")
    git("add", ".")
    git("commit", "--quiet", "-m", "one")
    untagged, undated = release.faults_of_commit(tmp_path, "9.1.0")
    assert untagged == "no commit has the tag v9.1.0; git tag -a v9.1.0, or --rehearse"
    assert undated == "CHANGELOG.md has no section 9.1.0 with its date"
    git("tag", "v9.1.0")
    (tmp_path / "CHANGELOG.md").write_text("# Changelog\n\n## 9.1.0 (2026-01-01)\n")
    assert release.faults_of_commit(tmp_path, "9.1.0") == [
        "the checkout has changes; commit or remove them, or --rehearse"
    ]
    git("commit", "--quiet", "-am", "two")
    (moved,) = release.faults_of_commit(tmp_path, "9.1.0")
    assert moved.startswith("the checkout is at ")
    assert moved.endswith("; git checkout v9.1.0, or --rehearse")
    git("tag", "--force", "v9.1.0")
    assert release.faults_of_commit(tmp_path, "9.1.0") == []


def test_a_package_that_states_no_licence_is_told_unless_it_was_read(tmp_path):
    stated = {"name": "numpy", "licenses": [{"expression": "BSD-3-Clause"}]}
    bill = tmp_path / "bill.cdx.json"
    bill.write_text(
        json.dumps({"components": [stated, {"name": "FMPy"}, {"name": "odd", "licenses": []}]})
    )
    assert release.faults_of_licences(bill) == [
        "odd states no licence; read its files and add it to LICENCES"
    ]


def test_what_fails_on_the_way_ends_the_rehearsal(tmp_path):
    with pytest.raises(SystemExit, match="exit code 3"):
        release.quiet(Path(sys.executable), "-c", "raise SystemExit(3)", folder=tmp_path)


def test_the_citation_is_one_of_its_format(tmp_path):
    check = [
        sys.executable,
        "-m",
        "check_jsonschema",
        "--builtin-schema",
        "vendor.citation-file-format",
    ]
    done = carried_out(*check, ROOT / "CITATION.cff")
    assert done.returncode == 0, done.stdout
    bad = tmp_path / "CITATION.cff"
    bad.write_text((ROOT / "CITATION.cff").read_text().replace("type: article", "type: leaflet"))
    done = carried_out(*check, bad)
    assert done.returncode == 1
    assert "'leaflet' is not one of" in done.stdout
