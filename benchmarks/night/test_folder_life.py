"""A results folder in the hands of two processes that begin, go on, stop or are killed, and of a disk that damages it.

Each process waits after every part that it has written, so that any order of both can be had. Whatever can be read is
at any time of the undisturbed batch, bit for bit, and whoever resumes it to the end has all of it.
"""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from functools import cache
from multiprocessing import get_all_start_methods, get_context
from pathlib import Path

import pandas as pd
import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from kit.command import judged
from servobench.harness.batch import results, store
from servobench.harness.batch.campaign import Campaign, Execution, Observer, carry_out
from servobench.harness.batch.integrity import examine
from servobench.harness.batch.lock import locked
from servobench.harness.batch.plan import Batch, SweepPlan
from servobench.harness.batch.processes import Bounds
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import Settings
from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError

RUNS = 4
BATCH = Batch(("kinematic",), ("constant",), ("random",), ("moderate",), range(RUNS))
CAMPAIGN = Campaign(SweepPlan(BATCH).cells(), Settings({"random": {"duration": 0.15}}), steps=True)
ANSWER_LIMIT = 120.0  # [s] of a process, on a busy machine
GO, STOP, DONE, STOPPED = "go", "stop", "done", "stopped"
# Where nothing can be saved
LOST = ("is not a results folder", "are not of this batch", "holds no finished run")
MANY = settings(max_examples=8, stateful_step_count=14, deadline=None)


class Waits(Observer):
    """Asks after each part whether to go on."""

    def __init__(self, link) -> None:
        self._link = link

    def finished(self, rows) -> None:
        self._link.send(len(rows))
        if self._link.recv() == STOP:
            raise KeyboardInterrupt


def work(link, folder: Path, resume: bool) -> None:
    """Carry the batch out in a process and say how that ended."""
    how = Execution(
        workers=1, block=1, resume=resume, observer=Waits(link), bounds=Bounds(isolate=False)
    )
    try:
        carry_out(CAMPAIGN, folder, how)
    except KeyboardInterrupt:
        link.send(STOPPED)
    except ConfigurationError as error:
        link.send(str(error))
    else:
        link.send(DONE)


class Worker:
    """A process that carries the batch out, part by part."""

    def __init__(self, folder: Path, resume: bool) -> None:
        context = get_context("fork")
        self._link, theirs = context.Pipe()
        # One that a failed test leaves behind ends with this process.
        self.process = context.Process(target=work, args=(theirs, folder, resume), daemon=True)
        self.process.start()
        theirs.close()

    def answer(self) -> int | str:
        """Return the number of runs that it has just written, or how it ended."""
        assert self._link.poll(ANSWER_LIMIT)
        found: int | str = self._link.recv()
        if isinstance(found, str):
            self.process.join()
        return found

    def tell(self, word: str) -> int | str:
        self._link.send(word)
        return self.answer()

    def kill(self) -> None:
        self.process.kill()
        self.process.join()


@cache
def undisturbed() -> tuple[pd.DataFrame, pd.DataFrame]:
    with tempfile.TemporaryDirectory() as name:
        carry_out(
            CAMPAIGN,
            Path(name) / "out",
            Execution(workers=1, block=1, bounds=Bounds(isolate=False)),
        )
        return tables(Path(name) / "out")


def tables(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    return judged(results.load_runs(folder)), judged(results.load_steps(folder))


def assert_equal(
    found: tuple[pd.DataFrame, pd.DataFrame], wanted: tuple[pd.DataFrame, pd.DataFrame]
) -> None:
    for table, whole in zip(found, wanted, strict=True):
        pd.testing.assert_frame_equal(table, whole.reset_index(drop=True), check_exact=True)


class FolderLife(RuleBasedStateMachine):
    """One folder; `writer` is the process that holds it, if any."""

    def __init__(self) -> None:
        super().__init__()
        self.place = Path(tempfile.mkdtemp(prefix="servobench-life-"))
        self.folder, self.writer, self.damaged = self.place / "out", None, False

    @rule(resume=st.booleans())
    def begin(self, resume: bool) -> None:
        """A process begins or resumes the batch; there is one at a time."""
        before = self.content()
        worker = Worker(self.folder, resume)
        answer = worker.answer()
        if self.writer is not None:
            assert "is being written by process" in answer or (
                not resume and "exists already" in answer
            ), answer
            assert self.content() == before
        elif not resume and before:
            assert "exists already" in answer, answer
            assert self.content() == before
        else:  # also where there is nothing yet to resume
            self.heard(worker, answer)

    @precondition(lambda self: self.writer is not None)
    @rule(word=st.sampled_from([GO, GO, GO, STOP]))
    def go_on(self, word: str) -> None:
        """The process that writes goes on, or is stopped by Ctrl-C."""
        answer = self.writer.tell(word)
        assert (answer == STOPPED) == (word == STOP), answer
        self.heard(self.writer, answer)

    @precondition(lambda self: self.writer is not None)
    @rule()
    def kill(self) -> None:
        self.writer.kill()
        self.writer = None

    @precondition(lambda self: self.writer is None)
    @rule(
        data=st.data(),
        share=st.floats(0.0, 0.99),
        how=st.sampled_from(["flip", "cut", "empty", "remove"]),
    )
    def damage(self, data, share: float, how: str) -> None:
        """A disk changes a file."""
        files = sorted(
            path for path in self.folder.rglob("*") if path.is_file() and path.name != SUMS
        )
        if not files:
            return
        path = data.draw(st.sampled_from(files))
        content = path.read_bytes()
        at = int(share * len(content))
        if how == "remove" or not content:
            path.unlink()
        elif how == "flip":
            path.write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        else:
            path.write_bytes(content[: at * (how == "cut")])
        self.damaged = True

    @precondition(
        lambda self: self.writer is None and not self.damaged and results_there(self.folder)
    )
    @rule()
    def collect(self) -> None:
        """A user puts together what there is."""
        with locked(self.folder):
            assert 0 < store.collect(ResultsFolder(self.folder)) <= RUNS

    @rule()
    def read(self) -> None:
        """Every row that can be read is one of the undisturbed batch."""
        if self.damaged or not results_there(self.folder):
            with contextlib.suppress(ConfigurationError):
                tables(self.folder)
            return
        found = tables(self.folder)
        names = found[0]["run_id"]
        assert names.is_unique
        assert_equal(found, tuple(whole[whole["run_id"].isin(names)] for whole in undisturbed()))

    @invariant()
    def nothing_is_wrong_unless_it_was_damaged(self) -> None:
        if results_there(self.folder) and self.writer is None and not self.damaged:
            assert not examine(ResultsFolder(self.folder)).findings

    def heard(self, worker: Worker, answer: int | str) -> None:
        """Take note of what a process says that had the folder to itself."""
        self.writer = worker if isinstance(answer, int) else None
        if answer == DONE:
            assert_equal(tables(self.folder), undisturbed())
            assert not examine(ResultsFolder(self.folder)).findings
            self.damaged = False
        elif isinstance(answer, str) and answer != STOPPED:
            assert self.damaged, answer
            assert any(words in answer for words in LOST), answer
            shutil.rmtree(self.folder)  # as a user does then
            self.damaged = False

    def content(self) -> dict[str, bytes]:
        return {
            str(path): path.read_bytes()
            for path in self.folder.rglob("*")
            if path.is_file() and not path.name.startswith(".")
        }

    def teardown(self) -> None:
        if self.writer is not None:
            self.writer.kill()
        shutil.rmtree(self.place)


def results_there(folder: Path) -> bool:
    return (folder / results.RUNS).exists() or (
        folder.is_dir() and bool(ResultsFolder(folder).part_indices())
    )


@pytest.mark.skipif(
    "fork" not in get_all_start_methods(), reason="copies of this process are needed"
)
def test_two_processes_and_a_bad_disk_lose_no_run_of_a_batch():
    undisturbed()
    run_state_machine_as_test(FolderLife, settings=MANY)
