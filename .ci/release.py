"""Builds a release from its commit, checks both files, installs each alone in a fresh environment and makes a run.

The packages that are installed with it, and their licences, are listed beside the wheel (CycloneDX).

    python .ci/release.py [--dist dist] [--python python3.13] [--rehearse]

The commit of version X.Y.Z has the tag vX.Y.Z; any other commit, and a checkout with changes, is refused. `--rehearse`
builds the checkout as it is. The files for an upload are left in the folder of `--dist`. Nothing is uploaded.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tarfile
import tempfile
import time
import tomllib
import zipfile
from email.message import Message
from email.parser import HeaderParser
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = "servobench"
NEEDED = (
    "py.typed",
    "__main__.py",
    "plant/contract/signals.py",
    "harness/cli/main.py",
    "harness/notebooks/analysis.ipynb",
)
UNWANTED = (".pyc", ".fmu", "/.venv/", "/results/", "/tests/")  # in a wheel
IN_SOURCE = (
    "pyproject.toml",
    "Makefile",
    "README.md",
    "LICENSE",
    "CHANGELOG.md",
    "requirements.lock",
    "tests/conftest.py",
)
LISTER = "cyclonedx-bom==7.5.0"
LICENCES = {"FMPy": "BSD-2-Clause"}  # read in the files of packages whose metadata states none
RUN = ("run", "--plant", "kinematic", "--set", "exp2.duration=1", "--out")


def main() -> None:
    """Make the files of a release; the first fault ends it with exit code 1."""
    parser = argparse.ArgumentParser(description="Make the files of a release.")
    parser.add_argument("--dist", type=Path, default=ROOT / "dist", help="folder for the files")
    parser.add_argument(
        "--python", default=sys.executable, help="interpreter of the fresh environment"
    )
    parser.add_argument(
        "--rehearse", action="store_true", help="build the checkout as it is, without a tag"
    )
    options = parser.parse_args()
    if not options.rehearse:
        end_with(faults_of_commit(ROOT, version_of(ROOT)))
    wheel, source = build(options.dist)
    end_with([*faults_of_wheel(wheel), *faults_of_source(source), *faults_of_versions(wheel, ROOT)])
    with tempfile.TemporaryDirectory(prefix=f"{PACKAGE}-release-") as folder:
        python = fresh_environment(options.python, Path(folder))
        for file, words in (
            (wheel, ["--only-binary", ":all:"]),
            (source, ["--no-deps", "--force-reinstall"]),
        ):
            began = time.monotonic()
            quiet(
                python,
                "-m",
                "pip",
                "install",
                "--quiet",
                "--disable-pip-version-check",
                *words,
                str(file),
            )
            print(f"{file.name}: installed in {time.monotonic() - began:.0f} s, {describe(python)}")  # noqa: T201
            rehearse(python, Path(folder) / f"run of {file.name}")
        bill = list_packages(python, Path(folder) / "tools", wheel.with_suffix(".cdx.json"))
        end_with(faults_of_licences(bill))
        print(f"{bill.name}: the packages that are installed with the release, with their licences")  # noqa: T201
    print(f"release: {wheel.name} and {source.name} install and run from the files alone")  # noqa: T201


def end_with(faults: list[str]) -> None:
    """End with exit code 1 if there are faults, a line each."""
    if faults:
        sys.exit("\n".join(f"release: {fault}" for fault in faults))


def version_of(root: Path) -> str:
    """Return the version that the project of a folder has."""
    return str(
        tomllib.loads((root / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    )


def faults_of_commit(root: Path, version: str) -> list[str]:
    """Return the differences of a checkout from the commit of a release: tag, changelog, changes since."""
    tag, head = f"v{version}", git(root, "rev-parse", "HEAD")
    tagged = git(root, "rev-parse", "--verify", "--quiet", f"{tag}^{{commit}}")
    faults = []
    if not tagged:
        faults.append(f"no commit has the tag {tag}; git tag -a {tag}, or --rehearse")
    elif tagged != head:
        faults.append(
            f"the checkout is at {head[:12]}, {tag} is {tagged[:12]}; git checkout {tag}, or --rehearse"
        )
    if git(root, "status", "--porcelain"):
        faults.append("the checkout has changes; commit or remove them, or --rehearse")
    if f"\n## {version} (" not in (root / "CHANGELOG.md").read_text(encoding="utf-8"):
        faults.append(f"CHANGELOG.md has no section {version} with its date")
    return faults


def git(root: Path, *words: str) -> str:
    """Return the output of a git command in a folder; empty if it fails."""
    return subprocess.run(
        ["git", *words], cwd=root, capture_output=True, text=True, check=False
    ).stdout.strip()


def build(dist: Path) -> tuple[Path, Path]:
    """Build wheel and source distribution into a folder and return their paths."""
    for old in dist.glob(f"{PACKAGE}-*"):
        old.unlink()
    quiet(Path(sys.executable), "-m", "hatchling", "build", "-d", str(dist.resolve()))
    (wheel,), (source,) = dist.glob("*.whl"), dist.glob("*.tar.gz")
    return wheel, source


def faults_of_wheel(path: Path) -> list[str]:
    """Return the faults of a wheel: names of files, metadata."""
    with zipfile.ZipFile(path) as wheel:
        names = set(wheel.namelist())
    faults = [
        f"{path.name} lacks {PACKAGE}/{name}" for name in NEEDED if f"{PACKAGE}/{name}" not in names
    ]
    faults += [
        f"{path.name} holds {name}"
        for name in sorted(names)
        if any(word in f"/{name}" for word in UNWANTED)
    ]
    top = {name.partition("/")[0] for name in names if ".dist-info/" not in name}
    if top != {PACKAGE}:
        faults.append(f"{path.name} installs {', '.join(sorted(top))}, wanted {PACKAGE} alone")
    told = metadata(path)
    faults += [
        f"{path.name} has no {key}"
        for key in ("Requires-Python", "License-Expression")
        if not told[key]
    ]
    if told["Description-Content-Type"] != "text/markdown":
        faults.append(f"{path.name} does not say that its description is Markdown")
    return faults


def faults_of_source(path: Path) -> list[str]:
    """Return the faults of a source distribution: missing files."""
    with tarfile.open(path) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    return [f"{path.name} lacks {name}" for name in IN_SOURCE if name not in names]


def faults_of_versions(wheel: Path, root: Path) -> list[str]:
    """Return the files that say another version than the wheel."""
    version = metadata(wheel)["Version"]
    told = {
        "pyproject.toml": version_of(root),
        "CITATION.cff": next(
            line.partition(":")[2].strip()
            for line in (root / "CITATION.cff").read_text(encoding="utf-8").splitlines()
            if line.startswith("version:")
        ),
    }
    return [
        f"{file} says version {found}, the wheel {version}"
        for file, found in told.items()
        if found != version
    ]


def metadata(wheel: Path) -> Message:
    """Return the metadata of a wheel."""
    with zipfile.ZipFile(wheel) as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".dist-info/METADATA"))
        return HeaderParser().parsestr(archive.read(name).decode())


def fresh_environment(python: str, folder: Path) -> Path:
    """Make an empty environment below a folder and return its interpreter."""
    subprocess.run([python, "-m", "venv", str(folder / "environment")], check=True)
    return folder / "environment" / ("Scripts/python.exe" if os.name == "nt" else "bin/python")


def list_packages(python: Path, folder: Path, path: Path) -> Path:
    """Write the packages of an environment as CycloneDX, by a tool in an environment of its own; return the path."""
    folder.mkdir()
    tool = fresh_environment(str(python), folder)
    quiet(tool, "-m", "pip", "install", "--quiet", "--disable-pip-version-check", LISTER)
    words = (
        "--output-reproducible",
        "--validate",
        "--pyproject",
        str(ROOT / "pyproject.toml"),
        "-o",
        str(path.resolve()),
    )
    quiet(tool, "-m", "cyclonedx_py", "environment", *words, str(python))
    return path


def faults_of_licences(bill: Path) -> list[str]:
    """Return the packages of a CycloneDX file that state no licence, unless it was read in their files."""
    parts = json.loads(bill.read_text(encoding="utf-8"))["components"]
    nameless = [
        each["name"] for each in parts if not each.get("licenses") and each["name"] not in LICENCES
    ]
    return [f"{name} states no licence; read its files and add it to LICENCES" for name in nameless]


def describe(python: Path) -> str:
    """Return how much an environment holds."""
    listed = quiet(
        python, "-m", "pip", "list", "--disable-pip-version-check", "--format", "freeze"
    ).splitlines()
    size = sum(
        path.stat().st_size
        for path in python.parents[1].rglob("*")
        if path.is_file() and not path.is_symlink()
    )
    return f"{len(listed)} packages, {size / 1e6:.0f} MB"


def rehearse(python: Path, folder: Path) -> None:
    """Make a run in an empty folder with the installed package."""
    folder.mkdir()
    quiet(python, "-m", PACKAGE, "--version", folder=folder)
    quiet(python, "-m", PACKAGE, *RUN, "out", folder=folder)
    if not (folder / "out" / "runs.parquet").is_file():
        sys.exit(f"release: the run left no table in {folder / 'out'}")


def quiet(python: Path, *words: str, folder: Path = ROOT) -> str:
    """Run Python without the checkout on its path and return its output; a failure ends the rehearsal with it."""
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(python), *words],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode:
        sys.exit(
            f"release: {' '.join(words)}: exit code {done.returncode}\n{done.stdout}{done.stderr}"
        )
    return done.stdout


if __name__ == "__main__":
    main()
