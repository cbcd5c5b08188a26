"""Worker processes that do not start: they are ended, and the reason is told."""

from __future__ import annotations

import multiprocessing

import pytest

from servobench.harness.batch import pool
from servobench.harness.batch.guard import Limits, Task
from servobench.harness.batch.pool import Pool
from servobench.harness.config.settings import ConfigurationError


def test_of_workers_that_start_too_late_none_is_left_for_which_this_process_would_wait(tmp_path, monkeypatch):
    (tmp_path / "slow_import.py").write_text("import time\n\ntime.sleep(60.0)\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(pool, "GUARD_START", 0.5)
    before = set(multiprocessing.active_children())
    workers = Pool(1, Limits(), ("slow_import",))
    try:
        for _ in range(2):
            with pytest.raises(ConfigurationError, match=r"^a worker process has not started within 0\.5 s$"):
                workers.submit(Task(print, b"")).result(60.0)
    finally:
        workers.stop()
    assert set(multiprocessing.active_children()) == before
