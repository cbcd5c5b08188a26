"""Files that belong together: all of them, or nothing that looks whole."""

import errno
import os

import pytest

from servobench.plant.contract.files import PARTIAL, writing_together


def write(folder, *, full=False):
    with writing_together(folder) as partial:
        (partial / "figures").mkdir()
        (partial / "figures" / "a.png").write_text("new")
        (partial / "table.csv").write_text("new")
        assert PARTIAL.fullmatch(partial.name)
        if full:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(partial / "page.html"))


def files(folder):
    return {
        f"{path.relative_to(folder)}": path.read_text()
        for path in folder.rglob("*")
        if path.is_file()
    }


NEW = {"figures/a.png": "new", "table.csv": "new"}


def test_a_folder_has_its_name_once_all_files_are_there(tmp_path):
    with pytest.raises(OSError, match="No space left") as full:
        write(tmp_path / "out", full=True)
    assert full.value.filename == str(tmp_path / "out" / "page.html")
    assert not any(tmp_path.iterdir())
    write(tmp_path / "out")
    assert files(tmp_path) == {f"out/{name}": text for name, text in NEW.items()}


def test_files_of_a_folder_that_is_there_are_replaced_together(tmp_path, monkeypatch):
    old = {"figures/a.png": "old", "table.csv": "old", "mine.txt": "old"}
    (tmp_path / "figures").mkdir()
    for name, text in old.items():
        (tmp_path / name).write_text(text)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(OSError, match="No space left"):
        write(tmp_path, full=True)
    assert files(tmp_path) == old
    for folder in (tmp_path, tmp_path.relative_to(tmp_path)):
        write(folder)
        assert files(tmp_path) == old | NEW
    assert sorted(each.name for each in tmp_path.iterdir()) == ["figures", "mine.txt", "table.csv"]
