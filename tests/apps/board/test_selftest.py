"""The fingerprint of the arithmetic in manifests, and the self-test against the stored numbers."""

import numpy as np
import pytest

from kit.command import finish, servobench, start
from servobench.harness.apps.board import selftest
from servobench.harness.apps.board.selftest import METHODS, read_reference
from servobench.harness.apps.board.selftest import compare as held_against
from servobench.harness.batch.api import compare
from servobench.harness.batch.fingerprint import fingerprint, numbers
from servobench.harness.batch.results import ResultsFolder


def test_the_fingerprint_of_a_batch_is_in_its_manifest(tmp_path):
    compare(["constant"], tasks=["exp1"], out=tmp_path / "out")
    manifest = ResultsFolder(tmp_path / "out").manifest
    assert manifest["fingerprint"] == fingerprint(["kinematic"], ["constant"])
    assert set(manifest["fingerprint"]) == {"libm", "ufuncs", "blas", "kinematic", "constant"}


def test_one_bit_in_a_roll_out_is_told_with_its_period():
    own = {"constant": np.ones((4, 3)), "blas": np.ones((2, 2))}
    other = {name: values.copy() for name, values in own.items()}
    other["constant"][2, 1] = np.nextafter(1.0, 2.0)
    found = {part.name: part for part in held_against(own, other)}
    assert found["blas"].difference == 0.0
    assert found["constant"].first == 2
    assert found["constant"].difference == pytest.approx(2.2e-16, rel=0.1)
    assert str(found["constant"]).endswith("differs by up to 2.2e-16, first in row 2")


def test_the_reference_has_each_part_of_the_self_test():
    machine, wanted = read_reference()
    assert machine.startswith("Python ")
    values = numbers(["kinematic"], METHODS)
    parts = list(held_against(values, wanted))
    assert [part.name for part in parts] == list(values)
    # Another machine may differ, but not by more than rounding in ten periods
    assert max(part.difference for part in parts) < 0.01


def test_code_of_users_has_no_part_in_the_fingerprint():
    assert fingerprint(["./plant.py"], ["./mine.py"]) == fingerprint([], [])


def test_the_self_test_names_each_part_and_says_whether_all_are_the_same(monkeypatch, capsys):
    code = servobench(monkeypatch, "selftest")
    printed = capsys.readouterr().out
    assert all(f"\n{name} " in printed for name in ("libm", "blas", "kinematic", *METHODS))
    assert code == int("bit for bit as the reference did" not in printed)


def test_the_reference_is_of_this_code_wherever_the_machine_is_that_of_the_reference():
    process = start("selftest")
    _, printed = finish(process)
    here, reference = (line.partition(": ")[2] for line in printed.splitlines()[:2])
    # Elsewhere a difference may be the machine's
    assert here != reference or process.returncode == 0, "run benchmarks/reference.py"


def test_a_plant_without_stored_numbers_is_refused_in_one_line(monkeypatch, capsys):
    assert servobench(monkeypatch, "selftest", "--plants", "fmu") == 2
    assert "--plants: fmu has no reference" in capsys.readouterr().err


def test_a_blas_without_a_version_is_told_as_such(monkeypatch):
    unknown = {"name": "mkl", "version": None, "kernel": None, "threads": 1}
    monkeypatch.setattr(selftest, "blas_libraries", lambda: [unknown])
    assert "mkl None None" in selftest.describe_machine()
