"""`import servobench` as a user's script sees it."""

import os
import re
import sys
from concurrent.futures import Executor
from functools import partial
from itertools import count

import numpy as np
import pandas as pd
import pytest

import servobench
from kit.command import judged, python
from kit.nightly import some
from kit.resting import Resting
from servobench.harness.config.entries import NoSettings
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark

SHORT = {"exp1": {"duration": 0.5}}


def test_a_line_says_that_a_controller_that_cannot_be_pickled_runs_in_this_process(caplog):
    class Local(Resting):
        """As Resting."""

    remark.cache_clear()
    for workers in (1, 2):
        table = servobench.compare([Local], settings=SHORT, workers=workers)
        assert table["status"].tolist() == ["completed"]
        assert ("its runs stay here, without limits" in caplog.text) == (workers == 2)


def test_isolation_with_an_executor_is_said_to_have_no_effect(caplog):
    remark.cache_clear()
    with pytest.raises(NotImplementedError):  # the abstract one takes no task
        servobench.compare(["constant"], settings=SHORT, executor=Executor(), isolate=True)
    assert "isolate has no effect with an executor" in caplog.text


BELOW_THE_GUARD = """
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
import servobench
from kit.resting import Resting

if __name__ == "__main__":
    class Mine(Resting):
        pass
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn")) as pool:
        servobench.compare([Mine], isolate=True)
"""


@pytest.mark.parametrize("place", ["isolate=True", "executor=pool"])
def test_a_controller_below_the_guard_of_a_script_is_refused_with_the_remedy(tmp_path, place):
    (tmp_path / "script.py").write_text(BELOW_THE_GUARD.replace("isolate=True", place))
    remedy = "define it above `if __name__ == '__main__':`"
    line = python(
        "script.py", path=tmp_path, PYTHONPATH=os.pathsep.join(sys.path)
    ).stderr.splitlines()[-1]
    assert "a worker process lacks a class: Can't get attribute 'Mine'" in line
    assert remedy in line
    for place in ("script.py", "script.py:Mine"):
        with pytest.raises(ValueError, match=f"defines no controller.*{remedy}"):
            servobench.run(f"{tmp_path}/{place}")


HOW = ("run_memory=2e9", "workers=2, out='out'")  # both start workers, the latter two


@pytest.mark.parametrize("how", some(HOW, HOW[0]))
def test_a_script_without_a_guard_gets_one_line_and_nothing_of_its_workers(tmp_path, how):
    (tmp_path / "script.py").write_text(
        f"import servobench\nservobench.compare(['constant'], seeds=2, {how})\n"
    )
    told = python("script.py", path=tmp_path).stderr
    assert (
        told.count("\n") == told.count("keep its calls below `if __name__ == '__main__':`") == 1
    ), told


def test_what_is_no_controller_and_a_name_that_is_taken_are_refused():
    with pytest.raises(
        ValueError,
        match="controller is of type int, wanted a subclass of servobench.Controller or a servobench.ControllerEntry",
    ):
        servobench.run(3)
    taken = servobench.ControllerEntry(
        "ukf_mfac", "", NoSettings, lambda _config, knowledge: Resting(knowledge)
    )
    with pytest.raises(ValueError, match="a controller called 'ukf_mfac' exists already"):
        servobench.compare([taken])
    with pytest.raises(ValueError, match="seeds must name at least one"):
        servobench.compare([Resting], seeds=())


RUN, COMPARE = (
    partial(servobench.run, "constant"),
    partial(servobench.compare, controllers=["constant"]),
)


@pytest.mark.parametrize(
    ("call", "given", "words"),
    [
        (RUN, {"task": None}, "task must be a name, got None"),
        (
            RUN,
            {"mismatch": 0.1},
            "mismatch must be a text such as 'moderate' or 'links=10%', got 0.1",
        ),
        (RUN, {"robot": 3}, "robot must be a name, got 3"),
        (RUN, {"sensing": None}, "sensing must be a name, got None"),
        (RUN, {"seed": 1.5}, "seed must be a non-negative integer, got 1.5"),
        (RUN, {"seed": np.float64(1.5)}, "seed must be a non-negative integer, got 1.5"),
        (
            RUN,
            {"settings": {"kinematic": {"lag": np.float64(-1.0)}}},
            "kinematic.lag must be at least 0, got -1.0",
        ),
        (RUN, {"seed": True}, "seed must be a non-negative integer, got True"),
        (
            RUN,
            {"seed": 10_500},
            "seed 10500 cannot be used to judge: 10000:20000 are kept for tuning",
        ),
        (
            RUN,
            {"seed": 2**63},
            "seeds must be at most 9223372036854775807, got 9223372036854775808",
        ),
        (
            RUN,
            {"settings": [1]},
            "settings must be sections with keys, such as {'kinematic': {'lag': 0.1}}, got [1]",
        ),
        (RUN, {"settings": {"kinematic": 3}}, "settings must be sections with keys"),
        (
            COMPARE,
            {"controllers": "constant"},
            "controllers must be a list, such as ['constant'], got 'constant'",
        ),
        (COMPARE, {"controllers": b"ab"}, "controllers must be a list, such as [b'ab'], got b'ab'"),
        (COMPARE, {"tasks": None}, "tasks must be a list"),
        (COMPARE, {"tasks": [[]]}, "task must be a name, got []"),
        (COMPARE, {"seeds": "3"}, "seeds must be a number of seeds or a list of them, got '3'"),
        (COMPARE, {"seeds": [2**63]}, "seeds must be at most 9223372036854775807"),
        (COMPARE, {"seeds": 10**9}, "seeds must name at most 1,000,000, got 1000000000"),
        (COMPARE, {"seeds": 2**63}, "seeds must name at most 1,000,000, got 9223372036854775808"),
        (
            COMPARE,
            {"seeds": count()},
            "seeds must name at most 1,000,000, see the list that was given",
        ),
        (
            COMPARE,
            {"seeds": np.ones((1, 2), int)},
            "seed must be a non-negative integer, got array([1, 1])",
        ),
        (COMPARE, {"workers": 0}, "workers must be a number above 0, got 0"),
        (COMPARE, {"workers": np.float64(-1.0)}, "workers must be a number above 0, got -1.0"),
        (COMPARE, {"workers": 1.5}, "workers must be a whole number, got 1.5"),
        (COMPARE, {"workers": float("inf")}, "workers must be a whole number, got inf"),
        (COMPARE, {"executor": 3}, "executor must be an executor of concurrent.futures, got 3"),
        (COMPARE, {"isolate": "no"}, "isolate must be True or False, got 'no'"),
        (COMPARE, {"out": 3}, "out must be the path of a folder, got 3"),
        (
            COMPARE,
            {"run_timeout": 10**400},
            "run_timeout must be below 1e300, or inf for no limit, got 1000",
        ),
        (COMPARE, {"run_timeout": -1}, "run_timeout must be a number above 0, got -1"),
        (COMPARE, {"run_memory": "2GB"}, "run_memory must be a number above 0, got '2GB'"),
        (COMPARE, {"resume": True}, "resume needs out, the folder to continue in"),
        (servobench.load, {"folder": 3}, "folder must be the path of a folder, got 3"),
        (
            COMPARE,
            {"executor": Executor(), "run_memory": 1e9},
            "limits of time and memory are for processes of",
        ),
    ],
)
def test_an_argument_of_the_wrong_type_is_refused_in_a_line(call, given, words):
    with pytest.raises(ConfigurationError, match=re.escape(words)):
        call(**given)


def test_a_seed_of_numpy_is_that_seed():
    (seed,) = seeds = np.arange(3, 4)
    short = {"tasks": ["exp2"], "settings": {"exp2": {"duration": 0.5}}, "workers": np.int64(1)}
    assert servobench.compare(["constant"], seeds=seeds, **short)["seed"].tolist() == [3]
    of_numpy, own = (
        servobench.run("constant", task="exp2", seed=each, settings={"exp2": {"duration": 0.5}})
        for each in (seed, 3)
    )
    pd.testing.assert_frame_equal(
        judged(pd.DataFrame([of_numpy.row])), judged(pd.DataFrame([own.row]))
    )


def test_every_public_name_has_a_docstring_and_no_other_name_is_there():
    assert set(servobench.__all__) <= set(dir(servobench))
    assert all(getattr(servobench, name).__doc__ for name in servobench.__all__)
    with pytest.raises(AttributeError, match="has no attribute 'walk'"):
        _ = servobench.walk


@pytest.mark.slow
def test_the_package_imports_nothing_heavy_and_folders_of_the_same_names_do_no_harm(tmp_path):
    for name in ("plant", "controllers", "harness", "fmus"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise RuntimeError('a foreign package')")
    (tmp_path / "script.py").write_text(
        "import sys, servobench\n"
        "assert not {'numpy', 'pandas'} & set(sys.modules)\n"
        "print(servobench.run('constant', settings={'exp1': {'duration': 0.5}}).row['status'])\n"
    )
    done = python("script.py", path=tmp_path)
    assert done.stdout.strip() == "completed", done.stderr
