"""Numpy's floating-point errors raise in every test."""

from __future__ import annotations

import numpy as np
import pytest


@pytest.fixture(autouse=True)
def _floating_point_errors_raise():
    with np.errstate(all="raise"):
        yield
