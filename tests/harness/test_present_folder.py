"""The present folder: foreign code may change it, and files that are named later keep their meaning."""

import errno
import os
from pathlib import Path

import numpy as np
import pytest

from servobench import Command, Controller, run
from servobench.harness.batch.blocks import open_workers
from servobench.harness.config.source import same_folder
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.fmu.mapping import FmuMapping, read_mapping

SHORT = {"exp1": {"duration": 0.2}}


class Wanderer(Controller):
    """Changes the folder at one of its steps."""

    when = "built"

    def __init__(self, knowledge):
        self.n = knowledge.spec.n
        self.wander("built")

    def wander(self, now):
        if now == self.when:
            os.chdir("/")

    def reset(self, observation, seed):
        self.wander("reset")

    def step(self, observation, reference):
        self.wander("step")
        return Command(np.zeros(self.n))


@pytest.mark.parametrize("when", ["built", "reset", "step"])
def test_a_run_ends_in_the_folder_in_which_it_began(when, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(Wanderer, "when", when)
    assert run(Wanderer, settings=SHORT).row["status"] == "completed"
    assert Path.cwd() == tmp_path


ROAM = """
import os
from dataclasses import dataclass

from servobench import Task
from servobench.harness.run.tasks import TASKS


@dataclass(frozen=True)
class Roam(Task):
    def scenario(self, setting):
        os.chdir("/")
        return TASKS["exp1"].default.scenario(setting)
"""


def test_a_task_that_changes_the_folder_leaves_the_names_of_files_as_they_are(
    tmp_path, monkeypatch
):
    (tmp_path / "roam.py").write_text(ROAM)
    monkeypatch.chdir(tmp_path)
    assert run("constant", task="./roam.py:Roam").row["status"] == "completed"
    assert Path.cwd() == tmp_path


def test_a_folder_that_is_deleted_meanwhile_does_no_harm(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    with same_folder():
        gone.rmdir()
    with same_folder():
        os.chdir(tmp_path)
    assert Path.cwd() == tmp_path


def test_messages_of_an_fmu_go_to_the_file_that_was_named_wherever_its_code_goes(
    tmp_path, monkeypatch
):
    (tmp_path / "arm.toml").write_text(
        'file = "arm.fmu"\ninputs = "u"\nfeatures = "y"\ndebug_log = "said.txt"\n'
    )
    monkeypatch.chdir(tmp_path)
    assert read_mapping(FmuMapping, Path("arm.toml")).debug_log == tmp_path / "said.txt"


def test_workers_are_refused_in_a_folder_that_was_deleted(tmp_path, monkeypatch):
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    with (
        pytest.raises(ConfigurationError, match="^the present folder was deleted; change to one"),
        open_workers(2),
    ):
        pass


def test_workers_are_refused_in_a_folder_that_must_not_be_entered(monkeypatch):
    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied", str(path))

    monkeypatch.setattr(os, "chdir", refuse)
    with (
        pytest.raises(ConfigurationError, match="cannot be entered: Permission denied; change to"),
        open_workers(2),
    ):
        pass
