"""Numpy errors raise in tests, examples stay the same, the user's cache is not touched, and interrupts arrive."""

import contextlib
import gc
import os
import shutil
import signal
import sys
import tempfile
from functools import cache

os.environ["OPENBLAS_NUM_THREADS"] = (
    "1"  # read by numpy's import: threads of several processes wait for each other
)

import numpy as np
import pytest
from hypothesis import settings

SLOW = {  # folders and files whose tests are all slow
    "closed_loop", "end_to_end", "films", "report", "tuning", "test_adapters", "test_analyse", "test_blocks",
    "test_chain", "test_check", "test_controller_fmu", "test_drives", "test_engine",
    "test_environments", "test_exit_codes", "test_fmu_model", "test_fmu_standard", "test_fmu_symbolic", "test_help",
    "test_integrity", "test_lists", "test_loops", "test_on_a_ur", "test_outcome", "test_page_tables",
    "test_plant_lanes", "test_robot_runs", "test_robots", "test_sensing_runs", "test_served_browser", "test_setups",
    "test_stability_limits", "test_units", "test_urdf", "test_verdict", "test_wrong_inputs",
}  # fmt: skip

# A busy machine is slow, which is no failure; and a change is judged by itself, not by examples that are new each time.
settings.register_profile("servobench", deadline=None, derandomize=True)
settings.load_profile("servobench")


def pytest_configure(config: pytest.Config) -> None:
    """Keep networks and FMUs that tests make in a folder of the session, which all workers and subprocesses share."""
    if hasattr(config, "workerinput"):
        return
    folder = tempfile.mkdtemp(prefix="servobench-tests-")
    config.add_cleanup(lambda: shutil.rmtree(folder, ignore_errors=True))
    os.environ["XDG_CACHE_HOME"] = folder
    cache = getattr(config, "cache", None)
    if cache is not None:
        # Seconds go into a list of the machine's fonts, which stays the same from session to session
        with contextlib.suppress(OSError):  # of a checkout that cannot be written
            os.environ["MPLCONFIGDIR"] = str(cache.mkdir("matplotlib"))
    # Some containers set it, and each of many subprocesses would compile the package anew
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    if shutil.which("cc") and "SERVOBENCH_NIGHTLY" not in os.environ:
        # Optimising an FMU takes longer than to run it
        os.environ.setdefault("CC", """sh -c 'cc "$@" -O0' cc""")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the slow tests first, so that the quick ones fill the end of a run in several processes."""
    for item in items:
        if SLOW & {item.path.parent.name, item.path.stem}:
            item.add_marker("slow")
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)


def pytest_collection_finish() -> None:
    """Leave all that is imported by now out of the garbage collector's rounds: a tenth of the time of the tests."""
    gc.freeze()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Return one process more than there are processors, as some of the slow tests wait for other processes."""
    return (os.cpu_count() or 1) + (not config.option.markexpr)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Hand a file whose tests share a fixture to one process, and all others test by test."""
    from xdist.scheduler import LoadGroupScheduling

    @cache
    def is_group(path: str) -> bool:
        return 'scope="module"' in (config.rootpath / path).read_text(encoding="utf-8")

    class ByGroup(LoadGroupScheduling):
        def _split_scope(self, nodeid: str) -> str:
            path = nodeid.split("::", maxsplit=1)[0]
            return path if is_group(path) else nodeid

    config.option.loadscopereorder = False  # the order is the one above
    return ByGroup(config, log) if config.getvalue("dist") == "loadgroup" else None


@pytest.fixture(scope="session", autouse=True)
def _interrupts_arrive():
    """Handle SIGINT and SIGHUP, which `nohup` and a shell's `&` leave ignored for all processes below them."""
    interrupt = signal.signal(signal.SIGINT, signal.default_int_handler)
    hang_up = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    yield
    signal.signal(signal.SIGINT, interrupt)
    signal.signal(signal.SIGHUP, hang_up)


@pytest.fixture(autouse=True)
def _floating_point_errors_raise():
    with np.errstate(all="raise"):
        yield


@pytest.fixture
def no_figures(monkeypatch):
    """Let commands draw no figures, which takes seconds."""
    monkeypatch.setattr("servobench.harness.apps.figures.figures.draw_figures", lambda _: [])


@pytest.fixture
def output_of(monkeypatch, capsys):
    """A function that carries out a command, which ends with an exit code, and returns what it printed."""
    from kit.command import servobench

    def call(*words: object, code: int = 0) -> str:
        capsys.readouterr()
        assert servobench(monkeypatch, *map(str, words)) == code
        return capsys.readouterr().out

    return call


@pytest.fixture
def refusal_of(monkeypatch, capsys):
    """A function that calls a command, which refuses with exit code 2 and in one line, and returns this line."""
    from kit.command import servobench

    def call(*words: object) -> str:
        capsys.readouterr()
        assert servobench(monkeypatch, *map(str, words)) == 2
        line = capsys.readouterr().err
        assert line.startswith("servobench: ")
        assert line.count("\n") == 1
        return line

    return call


@pytest.fixture
def own_folder(tmp_path, monkeypatch):
    """Give a test a folder, a path of imports and offers of its own."""
    from servobench.harness.config.registry import offering

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    with offering():
        yield
