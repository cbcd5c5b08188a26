"""`servobench new`: what it writes runs, keeps the contract, and overwrites nothing."""

import pytest

from kit.command import python, servobench

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.mark.slow
def test_new_files_pass_their_own_tests(output_of, tmp_path):
    for kind, name, check, options in (
        ("controller", "my_law", "check", ()),
        ("controller", "my_aided_law", "check", ("--aids",)),
        ("plant", "my_cell", "check plant", ()),
    ):
        assert f"servobench {check} ./laws/{name}.py" in output_of("new", kind, name, "--folder", "laws", *options)
    done = python("-m", "pytest", "-q", "-p", "no:cacheprovider", path=tmp_path / "laws")
    assert "6 passed" in done.stdout, done.stdout + done.stderr


def test_a_new_controller_with_aids_says_so_and_a_plant_has_none(refusal_of, output_of, monkeypatch, tmp_path):
    assert servobench(monkeypatch, "new", "controller", "my_law", "--aids") == 0
    lines = [line.split(maxsplit=2) for line in output_of("check", "./my_law.py").splitlines()]
    assert ["ok", "aids"] in lines
    line = refusal_of("new", "plant", "my_cell", "--aids")
    assert "--aids are those of a controller; leave the option out for a plant" in line
    assert not (tmp_path / "my_cell.py").exists()


@pytest.mark.parametrize("name", ["3d", "class", "my-law", "../mine", "test_mine", ""])
def test_a_name_that_no_module_may_have_is_refused(refusal_of, tmp_path, name):
    assert "the name must be one of a Python module, such as my_law" in refusal_of("new", "controller", name)
    assert list(tmp_path.iterdir()) == []
