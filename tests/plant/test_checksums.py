"""The lines that vouch for the files of a results folder: as they stand on the disk, and what they say of a file."""

import errno
import hashlib
import os
from pathlib import Path

import pytest

from servobench.harness.batch.tables import UnwritableFolder, sums_of, writing
from servobench.plant.contract.checksums import (
    SUMS,
    append_sums,
    fault,
    keep_sums,
    read_sums,
    write_vouched,
)
from servobench.plant.contract.faults import ConfigurationError

DIGESTS = "a" * 64, "b" * 64, "c" * 64


def sha256(content: bytes) -> str:
    return hashlib.sha256(content).hexdigest()


def test_the_file_is_one_that_sha256sum_reads(tmp_path):
    write_vouched(tmp_path, {"first.txt": lambda file: file.write_bytes(b"1")})
    write_vouched(tmp_path, {"second.txt": lambda file: file.write_bytes(b"2")})
    assert (
        tmp_path / SUMS
    ).read_text() == f"{sha256(b'1')}  first.txt\n{sha256(b'2')}  second.txt\n"


@pytest.mark.parametrize("half", ["a", "ab", DIGESTS[0] + "  na"])
def test_a_line_that_is_not_ended_is_passed_over_and_none_after_it(tmp_path, half):
    (tmp_path / SUMS).write_text(half)
    append_sums(tmp_path, {"name": DIGESTS[1]})
    assert (tmp_path / SUMS).read_text() == f"{half}\n{DIGESTS[1]}  name\n"
    assert read_sums(tmp_path)["name"] == frozenset([DIGESTS[1]])


def test_a_file_may_have_the_content_of_any_of_its_lines(tmp_path):
    append_sums(tmp_path, {"one": DIGESTS[0], "other": DIGESTS[2]})
    append_sums(tmp_path, {"one": DIGESTS[1]})
    assert read_sums(tmp_path) == {"one": frozenset(DIGESTS[:2]), "other": frozenset(DIGESTS[2:])}
    keep_sums(tmp_path, {"one": read_sums(tmp_path)["one"]})
    assert (tmp_path / SUMS).read_text() == f"{DIGESTS[0]}  one\n{DIGESTS[1]}  one\n"


def test_a_line_is_on_the_disk_after_its_file_and_before_that_file_has_its_name(
    tmp_path, monkeypatch
):
    events, written = [], []
    fsync, replace = os.fsync, Path.replace

    def synced(descriptor):
        path = Path(f"/proc/self/fd/{descriptor}").readlink()
        events.append(("on the disk", path.name))
        if path.name == SUMS:
            written.append(path.read_text().count("\n"))
        fsync(descriptor)

    def renamed(path, target):
        events.append(("named", target.name))
        return replace(path, target)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(Path, "replace", renamed)
    for name in ("first", "second"):
        write_vouched(tmp_path, {name: lambda file: file.write_text("content")})
    first, second = (event for event in events if event[1].startswith((".first-", ".second-")))
    folder = ("on the disk", tmp_path.name)
    lines = ("on the disk", SUMS)
    assert events == [
        first,
        lines,
        folder,
        ("named", "first"),
        folder,
        second,
        lines,
        ("named", "second"),
        folder,
    ]
    assert written == [1, 2]


def test_what_could_not_be_written_leaves_nothing(tmp_path):
    def fail(file):
        file.write_text("half")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_vouched(tmp_path, {"first": lambda file: file.write_text("whole"), "second": fail})
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("content", "unlisted", "unvouched"),
    [
        (b"", "is empty", "is empty"),
        (b"PAR", "is cut off", "is cut off"),
        (b"PAR1", f"is not listed in {SUMS}", None),
        (b"PAR1 and rows PAR1", f"is not listed in {SUMS}", None),
        (b"PAR1 and rows PAR", "is cut off", "is cut off"),
    ],
)
def test_a_table_is_judged_by_its_end_where_no_line_tells(tmp_path, content, unlisted, unvouched):
    (tmp_path / "runs.parquet").write_bytes(content)
    assert fault(tmp_path, "runs.parquet", {}) == unlisted
    assert fault(tmp_path, "runs.parquet", None) == unvouched
    assert (
        fault(tmp_path, "runs.parquet", {"runs.parquet": frozenset([DIGESTS[0], sha256(content)])})
        is None
    )


def test_a_file_that_is_no_table_has_no_end_to_be_judged_by(tmp_path):
    (tmp_path / "failures.log").write_text("some text")
    assert fault(tmp_path, "failures.log", None) is None
    assert (
        fault(tmp_path, "failures.log", {"failures.log": frozenset(DIGESTS)})
        == "was changed since it was written"
    )
    assert fault(tmp_path, "none", None) == "is missing"


def test_a_folder_in_the_place_of_a_file_is_named(tmp_path):
    (tmp_path / "runs.parquet").mkdir()
    assert fault(tmp_path, "runs.parquet", {}) == "cannot be read: Is a directory"
    (tmp_path / SUMS).mkdir()
    with pytest.raises(ConfigurationError, match=f"{SUMS} cannot be read: Is a directory"):
        sums_of(tmp_path)


def test_a_folder_that_takes_no_more_files_says_why_once(tmp_path):
    full = pytest.raises(
        UnwritableFolder, match=f"results folder {tmp_path} cannot be written: No space left"
    )
    with full as caught, writing(tmp_path / "other"), writing(tmp_path):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert caught.value.errno == errno.ENOSPC
    gone = tmp_path / "gone"
    with (
        pytest.raises(UnwritableFolder, match="gone cannot be written: it was removed"),
        writing(gone),
    ):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")
    with (
        pytest.raises(UnwritableFolder, match="cannot be written: No such file"),
        writing(tmp_path),
    ):
        raise FileNotFoundError(errno.ENOENT, "No such file or directory")
    with (
        pytest.raises(UnwritableFolder, match="gone cannot be written: No space left"),
        writing(gone),
    ):
        raise OSError(errno.ENOSPC, "No space left on device")
