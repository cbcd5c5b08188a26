"""What a manifest says of the installation: the commit of a checkout or why it is unknown, and the BLAS."""

import subprocess

import numpy as np
import pytest
import threadpoolctl

from servobench.harness.config import installation
from servobench.harness.config.installation import CommitUnknown, blas_libraries, version_line


@pytest.fixture
def checkout(tmp_path):
    def make(name):
        folder = tmp_path / name
        (folder / "plant").mkdir(parents=True)
        (folder / "plant" / "code.py").write_text(name)
        git(folder, "init", "-q")
        git(folder, "add", ".")
        git(folder, "-c", "user.name=a", "-c", "user.email=a@b", "commit", "-q", "-m", name)
        return folder

    return make


def git(folder, *words):
    return subprocess.run(
        ["git", *words], cwd=folder, check=True, capture_output=True, text=True
    ).stdout.strip()


def test_the_commit_is_that_of_the_own_checkout_even_below_a_hook_of_another(checkout, monkeypatch):
    own, other = checkout("own"), checkout("other")
    monkeypatch.setenv("GIT_DIR", str(other / ".git"))
    monkeypatch.setenv("GIT_WORK_TREE", str(other))
    monkeypatch.setenv("GIT_INDEX_FILE", str(other / ".git" / "index"))
    commit = installation.read_commit(own)
    monkeypatch.undo()
    assert commit == git(own, "rev-parse", "HEAD")
    (own / "plant" / "code.py").write_text("changed")
    assert installation.read_commit(own) == f"{commit}-dirty"
    assert installation.read_commit(own.parent) is None


def belongs_to_another(folder, monkeypatch):
    monkeypatch.setenv("GIT_TEST_ASSUME_DIFFERENT_OWNER", "1")  # a switch of git itself


def has_no_git(folder, monkeypatch):
    monkeypatch.setenv("PATH", str(folder / "plant"))


def has_a_damaged_index(folder, monkeypatch):
    (folder / ".git" / "index").write_bytes(b"damaged")


def has_no_commit(folder, monkeypatch):
    git(folder, "checkout", "-q", "--orphan", "fresh")


def points_nowhere(folder, monkeypatch):
    (folder / ".git").rename(folder / "moved")
    (folder / ".git").write_text("gitdir: /nowhere/at/all\n")


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (
            belongs_to_another,
            r"^the checkout belongs to another user; git config --global --add safe\.directory /",
        ),
        (has_no_git, "^git cannot be run: No such file"),
        (has_a_damaged_index, "^git says: .*index file"),
        (points_nowhere, "^git says: not a git repository: /nowhere/at/all"),
        (has_no_commit, "^the checkout has no commit yet$"),
    ],
)
def test_an_unknown_commit_has_its_reason(spoil, reason, checkout, monkeypatch):
    folder = checkout("own")
    spoil(folder, monkeypatch)
    with pytest.raises(CommitUnknown, match=reason):
        installation.read_commit(folder)


def test_the_version_says_why_the_commit_is_unknown(checkout, monkeypatch):
    monkeypatch.setattr(installation, "CHECKOUT", checkout("own"))
    monkeypatch.setattr(installation, "read_checkout", installation.read_checkout.__wrapped__)
    monkeypatch.setenv("PATH", "")
    assert version_line().endswith(
        " (commit unknown: git cannot be run: No such file or directory)"
    )


def test_the_loaded_blas_is_named_with_its_version_kernel_and_threads():
    told = [
        (each["name"], each["version"], each["threads"], each["kernel"])
        for each in blas_libraries()
    ]
    known = [each for each in threadpoolctl.threadpool_info() if each["user_api"] == "blas"]
    assert told == [
        (each["internal_api"], each["version"], each["num_threads"], each.get("architecture"))
        for each in known
    ]


def test_a_blas_that_cannot_be_asked_has_the_name_that_numpy_was_built_with(monkeypatch):
    monkeypatch.setattr(threadpoolctl.ThreadpoolController, "info", lambda _: [])
    built = np.show_config(mode="dicts")["Build Dependencies"]["blas"]
    assert blas_libraries() == [
        {"name": built["name"], "version": built["version"], "threads": None, "kernel": None}
    ]
