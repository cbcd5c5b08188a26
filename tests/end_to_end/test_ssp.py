"""The system of plant, controller and connections, run by FMPy, goes the way of the harness.

All methods and more arms: PYTHONPATH=benchmarks python -m night.system_loops, a part of `make nightly`.
"""

from __future__ import annotations

import zipfile

import numpy as np
import pytest
from fmpy.ssp.ssd import read_ssd

from night.system_loops import Loop, agree, both, write

LOOPS = [Loop("ukf_mfac:published"), Loop("map_mfac", "ur10e"), Loop("ukf_mfac:published", sensing="pixel")]


@pytest.fixture(scope="module")
def loop(tmp_path_factory):
    return write(LOOPS[0], tmp_path_factory.mktemp("ssp"))


@pytest.mark.parametrize("one", LOOPS, ids=" ".join)
def test_fmpy_runs_the_system_as_the_harness_runs_the_loop(one, tmp_path):
    found, wanted = both(one, write(one, tmp_path))
    assert agree(one, found, wanted), np.abs(found - wanted).max()
    assert not agree(one, found + 1e-6 * np.abs(wanted).max(), wanted)


def test_the_description_is_valid_and_names_every_connection_once(loop):
    read_ssd(str(loop))  # checks it against the schema
    with zipfile.ZipFile(loop) as archive:
        assert archive.namelist() == ["SystemStructure.ssd", "resources/controller.fmu", "resources/plant.fmu"]
        text = archive.read("SystemStructure.ssd").decode()
    assert text.count("<ssd:Connection ") == 6 + 3 + 3 + 6
