"""The cache: entries are made once, verify themselves, and are made anew where they are damaged."""

import errno
import os
import socket
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from servobench.plant.contract import cache
from servobench.plant.contract.cache import (
    MAX_AGE,
    MAX_ENTRIES,
    MIN_AGE,
    cache_folder,
    cached,
    is_whole,
)


@pytest.fixture(autouse=True)
def fresh(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
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
    with pytest.raises(
        ValueError, match="things cannot be written: .*make room there, or let XDG_CACHE_HOME name"
    ):
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
    # A use makes it young
    assert time.time() - (cache_folder("things") / names[-1]).stat().st_mtime < 60.0


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as there:
        os.chdir(path.parent)  # the path of a socket is short
        there.bind(path.name)


@pytest.mark.parametrize("place", ["key/SHA256SUMS", "key/files/one", ".lock", "key"])
@pytest.mark.parametrize("kind", [pipe, device, listening])
def test_what_is_no_file_is_replaced_and_never_read(kind, place, monkeypatch):
    make = Maker()
    monkeypatch.chdir(cached("things", "key", make))  # and back
    forget()
    path = cache_folder("things") / place
    if place == "key":
        cache._remove(path)
    else:
        path.unlink()
    kind(path)
    assert (cached("things", "key", make) / "one").read_bytes() == b"one"


def test_an_entry_is_shared_by_the_umask_and_code_is_its_owners():
    before = os.umask(0o022)
    try:
        data, code = cached("things", "key", Maker()), cached("extracted", "key", Maker())
    finally:
        os.umask(before)
    assert data.parent.stat().st_mode & 0o777 == 0o755
    assert (data / "deep" / "two").stat().st_mode & 0o777 == 0o644
    assert code.parent.stat().st_mode & 0o777 == 0o700


@pytest.mark.parametrize(
    ("shared", "mode", "group", "own"),
    [
        ("extracted", 0o757, 0, False),
        ("extracted", 0o775, 77, False),
        ("extracted", 0o1777, 0, False),
        ("", 0o777, 0, False),
        ("", 0o775, None, True),
        ("", 0o755, 77, True),
    ],
)
@pytest.mark.skipif(os.geteuid() != 0, reason="gives folders to other groups")
def test_code_is_not_kept_where_another_user_could_write_it(shared, mode, group, own, tmp_path):
    folder = tmp_path / "servobench" / shared
    folder.mkdir(parents=True)
    if group is not None:
        os.chown(folder, -1, group)
    folder.chmod(mode)
    files = cached("extracted", "key", Maker())
    assert files.is_relative_to(tmp_path / "temporary") == (not own)
    assert not cached("things", "key", Maker()).is_relative_to(tmp_path / "temporary")


@pytest.mark.skipif(os.geteuid() != 0, reason="gives folders to another user")
def test_code_of_another_user_is_not_loaded(tmp_path):
    other = cached("extracted", "key", Maker())
    os.chown(tmp_path / "servobench" / "extracted", 12345, 12345)
    forget()
    assert cached("extracted", "key", Maker()) != other
    (tmp_path / "temporary" / f"servobench-{os.geteuid()}").chmod(0o777)
    forget()
    with pytest.raises(
        ValueError, match="other users could write code into the cache folders .*XDG_CACHE_HOME"
    ):
        cached("extracted", "key", Maker())


def test_code_is_kept_where_it_can_be_loaded_and_where_uris_read_as_paths(tmp_path, monkeypatch):
    plain = cached("extracted", "key", Maker())
    assert plain.is_relative_to(tmp_path / "servobench")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "with blank"))
    assert cached("extracted", "key", Maker()).is_relative_to(tmp_path / "temporary")
    assert cached("things", "key", Maker()).is_relative_to(tmp_path / "with blank")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(cache, "forbids_code", lambda folder: "temporary" not in str(folder))
    assert cached("extracted", "key", Maker()).is_relative_to(tmp_path / "temporary")


@pytest.mark.parametrize("home", [None, "/nonexistent", "/dev/null"])
def test_without_a_home_a_temporary_folder_is_the_cache_and_one_line_says_so(
    home, tmp_path, monkeypatch
):
    said: set[str] = set()
    monkeypatch.setattr(cache, "remark", said.add)
    monkeypatch.delenv("XDG_CACHE_HOME")
    if home is None:
        monkeypatch.setattr(Path, "home", no_home)
    else:
        monkeypatch.setenv("HOME", home)
    place = tmp_path / "temporary" / f"servobench-{os.geteuid()}"
    for kind in ("things", "extracted"):
        assert cached(kind, "key", Maker()) == place / kind / "key" / "files"
        assert cache_folder(kind) == place / kind
    assert place.stat().st_mode & 0o777 == 0o700
    line = f"no cache folder can be written; {place} takes its place: let XDG_CACHE_HOME name one that stays"
    assert said == {line}


def no_home():
    raise RuntimeError("Could not determine home directory.")


def test_an_entry_that_cannot_be_replaced_is_passed_by(tmp_path, monkeypatch):
    unreadable = cached("things", "key", Maker())
    (unreadable / "one").write_bytes(b"of another user")
    forget()
    remove = cache._remove

    def refuse(entry):
        if entry == unreadable.parent:
            raise PermissionError(errno.EACCES, "Permission denied", str(entry))
        remove(entry)

    monkeypatch.setattr(cache, "_remove", refuse)
    make = Maker()
    for _ in range(2):
        assert cached("things", "key", make).is_relative_to(tmp_path / "temporary")
        forget()
    assert make.calls == 2  # both places, once


def test_a_lock_that_another_user_holds_for_ever_is_waited_for_a_while_only(monkeypatch):
    monkeypatch.setattr(cache, "LOCK_TIME", 0.05)
    cached("things", "key", Maker())
    with cache._alone(cache_folder("things")):
        assert cached("things", "other", Maker()).is_dir()
