"""The cache: entries are made once, verify themselves, and are made anew where they are damaged."""

import os
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from servobench.plant.contract import cache
from servobench.plant.contract.cache import MAX_AGE, MAX_ENTRIES, MIN_AGE, cache_folder, cached, is_whole


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "_verified", set())


class Maker:
    """Writes two files and counts how often it is called."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, folder: Path) -> None:
        self.calls += 1
        (folder / "deep").mkdir()
        (folder / "one").write_bytes(b"one")
        (folder / "deep" / "two").write_bytes(b"two")


def forget() -> None:
    """Do what a new process does."""
    cache._verified.clear()


DAMAGES = {
    "flipped": lambda files: (files / "one").write_bytes(b"onE"),
    "cut short": lambda files: (files / "deep" / "two").write_bytes(b""),
    "removed": lambda files: (files / "one").unlink(),
    "checksums cut short": lambda files: (files.parent / "SHA256SUMS").write_text("2c26b46b68ffc6"),
    "checksums empty": lambda files: (files.parent / "SHA256SUMS").write_text(""),
    "checksums of another kind": lambda files: (files.parent / "SHA256SUMS").write_text("[1]\n"),
    "no checksums": lambda files: (files.parent / "SHA256SUMS").unlink(),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_entry_is_made_anew_by_the_next_process(damage):
    make = Maker()
    files = cached("things", "key", make)
    forget()
    assert cached("things", "key", make) == files
    assert make.calls == 1
    DAMAGES[damage](files)
    forget()
    assert cached("things", "key", make) == files
    assert make.calls == 2
    assert (files / "one").read_bytes() + (files / "deep" / "two").read_bytes() == b"onetwo"
    assert sorted(each.name for each in cache_folder("things").iterdir()) == [".lock", "key"]


def test_what_an_fmu_writes_beside_its_files_does_no_harm():
    make = Maker()
    (cached("things", "key", make) / "log.txt").write_text("said")
    forget()
    cached("things", "key", make)
    assert make.calls == 1


def test_nothing_is_left_of_an_entry_that_cannot_be_made():
    def fail(folder: Path) -> None:
        (folder / "half").write_text("half")
        raise RuntimeError("no compiler")

    with pytest.raises(RuntimeError, match="no compiler"):
        cached("things", "key", fail)
    assert list(cache_folder("things").iterdir()) == []


def test_a_folder_that_cannot_be_written_is_one_line_with_the_remedy():
    cache_folder("things").parent.mkdir(parents=True)
    cache_folder("things").write_text("a file")
    with pytest.raises(ValueError, match="things cannot be written: .*make room there, or let XDG_CACHE_HOME name"):
        cached("things", "key", Maker())


def test_threads_that_make_the_same_entry_all_get_it_whole():
    def obtain(_: int) -> bytes:
        forget()
        return (cached("things", "key", Maker()) / "deep" / "two").read_bytes()

    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(obtain, range(40))) == {b"two"}
    assert is_whole(cache_folder("things") / "key")
    assert sorted(each.name for each in cache_folder("things").iterdir()) == [".lock", "key"]


def test_entries_that_were_not_used_for_long_are_removed():
    def age(key: str, seconds: float) -> None:
        then = time.time() - seconds
        os.utime(cache_folder("things") / key, (then, then))

    names = [f"key{i:02}" for i in range(MAX_ENTRIES + 2)]
    for name in names:
        cached("things", name, Maker())
    (cache_folder("things") / ".unfinished-1").mkdir()
    for i, name in enumerate(names):
        age(name, 60.0 * i)
    age(names[1], MAX_AGE + 60.0)
    age(names[2], MIN_AGE + 60.0)
    age(".unfinished-1", MIN_AGE + 60.0)
    cached("things", "new", Maker())
    left = {each.name for each in cache_folder("things").iterdir()} - {".lock", "new"}
    assert left == {*names} - {names[1], names[2]}
    forget()
    cached("things", names[-1], Maker())
    assert time.time() - (cache_folder("things") / names[-1]).stat().st_mtime < 60.0  # a use makes it young
