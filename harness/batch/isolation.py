"""Isolation of the code of users: a guard, and below it the process that carries the code out.

    this process ── task ──> guard ── task ──> runner      answers return the same way, one by one
                             imports servobench, no plug-in; limits time, memory and processes of all below it

Answers are data: JSON, which is read and never executed, since code of users may have falsified it. The runner is a
copy of the guard, so that a new one takes milliseconds. It is ended, with every process below the guard, when a run
takes too long, holds too much memory or kills it; when the code of users changes, so that no plug-in meets the remains
of another; when a task is over and left processes or much memory behind; and when the link to this process closes,
also because this process was killed.
"""

import contextlib
import faulthandler
import gc
import json
import math
import os
import pickle
import signal
import sys
import tempfile
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from multiprocessing import current_process, get_context, resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, TypeAlias

from servobench.harness.batch import processes
from servobench.harness.batch.processes import Limits, show_size
from servobench.harness.run.result import CRASHED, INSTANT, LOST, OUT_OF_MEMORY, TIMED_OUT, Ending
from servobench.plant.contract.faults import ConfigurationError

LOOK_EVERY = 0.25  # [s] between two checks of time, memory and processes
START_TIME = 60.0  # [s] at least until a runner has loaded the code of a task
GUARD_START = (
    1800.0  # [s] until a guard has imported servobench: a machine may be busy, and a batch long
)
GRACE = 30.0  # [s] beyond the time limit, after which a silent guard is ended


class WorkersNotStarted(ConfigurationError, SystemExit):
    """No worker process can be started; where nothing catches it, a script ends with its line alone."""

    def __init__(self, message: str) -> None:
        """Keep the message, which Python prints."""
        super().__init__(message)
        self.code = str(self)


START_ERROR = 1  # exit code of a guard that an error has kept from starting
STOP_TIME = 4.0  # [s] for a guard to end the processes below it
TRACE_TIME = 0.3  # [s] for the trace of a run that hangs
MAX_PROCESSES = 256  # below a guard: more belong to a run that copies itself
MAX_ANSWER = 2**30  # [bytes] length of one answer: a larger one is damaged
MESSAGE_PAUSE = 10  # [s] without a further byte, after which a message of a runner is given up
SILENT = "the process of the run reported it as done without its answer"
TALKATIVE = "the process of the run gave more answers than it had runs"
KEPT_SHARE = 0.5  # share of the memory limit that a runner may hold between two tasks
GUARD = "servobench guard"  # name of its process
ITEM, ALIVE, DONE, ENDED = b"i", b"a", b"d", b"e"  # first byte of a message upwards

# Passes an answer of JSON values up; None is only a sign of life
Tell: TypeAlias = Callable[[Any], None]
Work: TypeAlias = Callable[[Any, Tell], None]  # takes its argument, and tells its answers


@dataclass(frozen=True)
class Task:
    """A function of this package with its pickled argument."""

    function: Work
    argument: bytes
    owner: str = (
        ""  # whose code it runs: different owners never share a runner; "" for this package
    )
    fresh: bool = False  # needs a runner that has carried nothing out before
    answers: int | None = None  # number of its answers; None for any

    def carry_out(self, tell: Tell) -> None:
        """Call the function in this process."""
        self.function(pickle.loads(self.argument), tell)


@dataclass(frozen=True)
class End:
    """The premature end of a task."""

    ending: Ending
    certain: bool  # whether its current run is the cause, and no earlier run of the same runner


@dataclass(frozen=True)
class Answer:
    """The answers of a task, None for one that cannot be read, and its premature end if it had one."""

    items: list[Any] = field(default_factory=list)
    end: End | None = None


@dataclass(frozen=True)
class Workers:
    """A place where tasks are carried out: this process, isolated processes or a cluster."""

    submit: Callable[..., Any] | None = (
        None  # takes a `Task` and returns a future; None: runs stay in this process
    )
    count: int = 1  # number of tasks that are carried out at a time
    cluster: bool = False  # whether runs happen on other machines
    lost: tuple[type[BaseException], ...] = ()  # errors of a future whose process died
    check: Callable[[], None] = lambda: None  # raises an error once no worker comes back


def call(function: Work, argument: object, limits: Limits, hear: Tell) -> Ending | None:
    """Call a function in an isolated process, which is a copy of this one.

    Args:
        function: takes the argument and `tell`, which passes an answer of JSON values on.
        argument: of the function; it can be pickled.
        limits: of the call.
        hear: receives the answers; None for one that cannot be read.

    Returns:
        How the function ended if it did not return.
    """
    isolated = IsolatedProcess(limits, (), copied=True)
    try:
        end = isolated.carry_out(Task(function, pickle.dumps(argument), "user"), hear).end
    finally:
        isolated.ask_to_end()
        isolated.end()
    return None if end is None else end.ending


class Pool:
    """Isolated processes, which start with the first tasks, and the threads that talk to them."""

    def __init__(
        self, count: int, limits: Limits, modules: Sequence[str], *, copied: bool = False
    ) -> None:
        """Prepare isolated processes.

        Args:
            count: number of isolated processes.
            limits: of each run.
            modules: imported once by each guard.
            copied: whether the guards are copies of this process.
        """
        self._limits, self._modules, self._copied = limits, modules, copied
        self._threads = ThreadPoolExecutor(count)
        self._own = threading.local()
        self._isolated: list[IsolatedProcess] = []

    def submit(self, task: Task, hear: Tell | None = None) -> Future[Answer]:
        """Carry a task out; `hear` receives the answers instead of the future, in another thread."""
        return self._threads.submit(self._carry_out, task, hear)

    def stop(self, patience: float = STOP_TIME) -> None:
        """End everything, within a time [s]; a task that was not carried out has no answer."""
        self._threads.shutdown(wait=False, cancel_futures=True)
        for isolated in self._isolated:
            isolated.ask_to_end()
        for isolated in self._isolated:
            isolated.end(patience)

    def _carry_out(self, task: Task, hear: Tell | None) -> Answer:
        if not hasattr(self._own, "isolated"):
            self._own.isolated = IsolatedProcess(self._limits, self._modules, copied=self._copied)
            self._isolated.append(self._own.isolated)
        return self._own.isolated.carry_out(task, hear)


class IsolatedProcess:
    """A guard as seen from this process; one that was ended, for instance by a plug-in, is started anew."""

    def __init__(self, limits: Limits, modules: Sequence[str], *, copied: bool = False) -> None:
        """Prepare a guard.

        Args:
            limits: of each run.
            modules: imported once by the guard.
            copied: whether the guard is a copy of this process, in which no other thread may be busy.
        """
        self._limits, self._modules, self._copied = limits, modules, copied
        self._lock, self._ended = threading.Lock(), False
        self._process: BaseProcess | None = None
        self._link: Connection | None = None

    def carry_out(self, task: Task, hear: Tell | None) -> Answer:
        """Carry one task out; `hear` receives the items instead of the answer.

        Raises:
            ConfigurationError: no process can be started.
        """
        answer, limit = Answer(), max(self._limits.time, START_TIME) + GRACE
        silence = Ending(TIMED_OUT, f"the run took longer than {limit:g} s")
        try:
            link = self._start()
            link.send_bytes(pickle.dumps(task))
            while self._hears(link, limit):
                message = link.recv_bytes()
                kind, content = message[:1], message[1:]
                if kind == DONE:
                    return answer
                if kind == ENDED:
                    end = json.loads(content)
                    return Answer(answer.items, End(Ending(**end["ending"]), end["certain"]))
                if kind == ITEM:
                    item = None  # the answer where it is no JSON
                    with contextlib.suppress(ValueError, RecursionError):
                        item = json.loads(content)
                    (hear or answer.items.append)(item)
        except (EOFError, OSError):
            silence = Ending(CRASHED, LOST)
        self.end(0.0)  # it is gone or of no use, and nothing may wait for it when this process ends
        return Answer(answer.items, End(silence, certain=False))

    def ask_to_end(self) -> None:
        """Ask the guard to end the processes below it, and itself."""
        with self._lock:
            self._ended = True
            if self._process is not None:
                self._process.terminate()

    def end(self, patience: float = STOP_TIME) -> None:
        """End a guard, and the processes below it if it has not ended by itself within a time [s]."""
        with self._lock:
            process, self._process, self._link = self._process, None, None
            if process is None:
                return
            processes.await_end(process, patience)
            if process.is_alive() and process.pid is not None:
                processes.send(processes.descendants(process.pid), signal.SIGKILL)
            process.kill()
            process.join()

    def _hears(self, link: Connection, limit: float) -> bool:
        """Wait for a message, and return whether one came within a time [s]; a stopped guard is continued."""
        deadline = time.monotonic() + limit
        while not link.poll(LOOK_EVERY):
            if time.monotonic() > deadline:
                return False
            processes.wake(self._process)
        return True

    def _start(self, *, again: bool = True) -> Connection:
        """Return the link to a guard that runs; one that is ended while it starts is started once `again`."""
        if self._link is not None:
            return self._link
        if current_process().daemon:
            raise ConfigurationError(
                "a daemonic process, such as one of multiprocessing.Pool, can start no worker processes; compare there "
                "with workers=1 and without limits"
            )
        context = get_context("fork") if self._copied else get_context("spawn")
        if not self._copied:
            resource_tracker.ensure_running()  # it ends the block of interrupts below if it starts there
        ours, theirs = context.Pipe()
        inherited = (ours,) if self._copied else ()
        # Python does not tell it otherwise
        tracker = getattr(resource_tracker._resource_tracker, "_pid", None)
        arguments = (
            self._modules,
            __name__,
            "keep_guard",
            theirs,
            self._limits,
            inherited,
            tracker,
        )
        process: BaseProcess = context.Process(target=processes.begin, name=GUARD, args=arguments)
        with self._lock:
            if self._ended:
                raise EOFError
            with _signals_blocked(), warnings.catch_warnings():  # a process inherits the former
                # Python 3.12 warns of the threads of libraries, which only wait.
                warnings.simplefilter("ignore", DeprecationWarning)
                process.start()
            self._process = process
        theirs.close()
        if fault := self._start_fault(ours, process):
            ended = process.exitcode  # before the next line ends it
            ours.close()
            self.end(0.0)
            if again and ended not in (None, START_ERROR):
                return self._start(again=False)
            raise WorkersNotStarted(fault)
        self._link = ours
        return ours

    def _start_fault(self, link: Connection, process: BaseProcess) -> str:
        """Wait until a guard has started and return why it has not; empty if it has."""
        with contextlib.suppress(EOFError, OSError):
            if not self._hears(link, GUARD_START):
                return f"a worker process has not started within {GUARD_START:g} s"
            if link.recv_bytes() == ALIVE:
                return ""
        code = processes.await_end(process, STOP_TIME)
        if code not in (None, START_ERROR):
            return f"a worker process was ended while it started{_describe_exit(code)}"
        return (
            "the worker processes cannot be started; a script that starts some must be a file and keep its calls "
            "below `if __name__ == '__main__':`"
        )


@contextlib.contextmanager
def _signals_blocked() -> Iterator[None]:
    """Hold Ctrl-C and a request to end back in this thread and in processes that are started meanwhile."""
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT, signal.SIGTERM})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def keep_guard(
    link: Connection, limits: Limits, inherited: Sequence[Connection], tracker: int | None
) -> None:
    """Be a guard: take tasks from a link until it closes.

    Args:
        link: to the process above.
        limits: of each run.
        inherited: ends of links that a copy must not keep.
        tracker: process of Python that tracks the resources of the one above, if there is one.
    """
    for each in inherited:
        each.close()
    # No exception, which a destructor would swallow; and the link stays open, as it may be about to be read
    signal.signal(signal.SIGTERM, lambda *_: processes.hang_up(link.fileno()))
    processes.adopt_orphans()
    processes.keep_freed_memory()
    gc.freeze()  # so that runners go on sharing the memory of all imports
    # The default of Python 3.11; a copy of the command has a larger one, under which memory piles up.
    gc.set_threshold(700)
    guard = _Guard(link, limits)
    try:
        link.send_bytes(ALIVE)
        guard.serve()
    except (EOFError, OSError):  # the other side has ended
        pass
    finally:
        guard.close()
        # A stopped one does not notice that it is to end
        processes.send([tracker] if tracker else [], signal.SIGCONT)


class _Guard:
    def __init__(self, link: Connection, limits: Limits) -> None:
        self._link, self._limits = link, limits
        self._runner: Any = None
        self._below: Connection | None = None
        self._owner, self._answers = "", 0
        self._trace = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as the guard lives

    def serve(self) -> None:
        """Carry tasks out until the link closes."""
        while True:
            task: Task = pickle.loads(self._link.recv_bytes())
            below = self._ready(task)
            try:
                below.send_bytes(pickle.dumps(task))
                end = self._watch(below, task.answers)
            except (EOFError, OSError):
                end = self._find_end()
            if end is not None:
                self._link.send_bytes(ENDED + json.dumps(asdict(end)).encode())
                continue
            self._link.send_bytes(DONE)
            if self._is_used_up(task):
                self.end_runner()

    def _ready(self, task: Task) -> Connection:
        """Return the link to a runner that may carry out a task."""
        if self._below is not None and task.owner == self._owner and not task.fresh:
            return self._below
        self.end_runner()
        context = get_context("fork")
        below, theirs = context.Pipe()
        processes.limit_silence(below.fileno(), MESSAGE_PAUSE)
        self._trace.seek(0)
        self._trace.truncate()
        arguments = (theirs, (self._link, below), self._limits, self._trace.fileno(), os.getpid())
        runner = context.Process(target=_be_runner, args=arguments)
        runner.start()  # an OSError where the system has no more processes
        theirs.close()
        self._below, self._runner, self._owner, self._answers = below, runner, task.owner, 0
        INSTANT.value = math.nan
        return below

    def _watch(self, below: Connection, wanted: int | None) -> End | None:
        """Pass the answers of the runner on until it is done; return its premature end.

        Code of users can write to the link as well. A task therefore begins once, and ends with as many answers as it
        was given runs.
        """
        patience = max(self._limits.time, START_TIME)
        since = time.monotonic()
        begun = False
        given = 0
        while True:
            ready = wait([below, self._link], LOOK_EVERY)
            if below in ready:
                message = below.recv_bytes(MAX_ANSWER)
                kind = message[:1]
                if kind == DONE and given < (wanted or 0):
                    return self._end(CRASHED, SILENT, certain=False)
                if kind == DONE:
                    return None
                if kind not in (ITEM, ALIVE) or (kind == ALIVE and begun):
                    return self._find_end()
                begun = True
                patience = self._limits.time
                since = time.monotonic()
                self._link.send_bytes(message)
                if kind == ITEM:
                    given += 1
                    self._answers += 1
                if wanted is not None and given > wanted:
                    return self._end(CRASHED, TALKATIVE, certain=False)
            elif self._link in ready:  # nobody sends a second task: the other side has ended
                sys.exit(1)
            elif time.monotonic() - since > patience:
                with contextlib.suppress(OSError):
                    os.kill(self._runner.pid, signal.SIGUSR1)  # writes a trace
                    time.sleep(TRACE_TIME)
                return self._end(TIMED_OUT, f"the run took longer than {patience:g} s")
            elif (end := self._check_processes()) is not None:
                return end

    def _check_processes(self) -> End | None:
        """Check memory and number of the processes below; end them if it is too much, and continue a stopped runner."""
        processes.wake(self._runner)
        below = processes.descendants(os.getpid())
        if len(below) > MAX_PROCESSES:
            return self._end(CRASHED, f"the run started more than {MAX_PROCESSES} processes")
        most = self._limits.memory
        if processes.resident_memory(below) > most and processes.own_memory(below) > most:
            reason = f"the run held more than {show_size(most)} of memory"
            return self._end(OUT_OF_MEMORY, reason, certain=not self._answers)
        processes.collect_ended(each for each in below if each != self._runner.pid)
        return None

    def _find_end(self) -> End:
        """Return the end of a runner that is gone, or whose link is."""
        code = processes.await_end(self._runner, TRACE_TIME)
        return self._end(CRASHED, LOST + _describe_exit(code) + _describe_instant(), certain=False)

    def _end(self, status: str, reason: str, *, certain: bool = True) -> End:
        """End the runner and all below it."""
        self.end_runner()
        self._trace.seek(0)
        return End(
            Ending(status, reason, self._trace.read(4096).decode(errors="replace").strip()), certain
        )

    def _is_used_up(self, task: Task) -> bool:
        """Return whether a runner kept something that its next task should not meet."""
        if not task.owner and self._limits.memory == math.inf:
            return False
        below = processes.descendants(os.getpid())
        return len(below) > 1 or processes.resident_memory(below) > KEPT_SHARE * self._limits.memory

    def close(self) -> None:
        """End the runner, and close the file of its traces."""
        self.end_runner()
        self._trace.close()

    def end_runner(self) -> None:
        """End the runner and every process that runs have left behind."""
        if self._below is not None:
            self._below.close()
            self._runner.kill()
            processes.await_end(self._runner, processes.END_TIME)
            self._below = self._runner = None
        processes.end_descendants()


def _be_runner(
    link: Connection, inherited: Sequence[Connection], limits: Limits, trace: int, guard: int
) -> None:
    """Be a runner: take tasks from the guard until it is gone."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    processes.lead_session()
    processes.end_with_parent(guard)
    for each in inherited:
        each.close()
    processes.forget_tracker()
    # An interrupt has no effect here. It is not ignored, as programs started here would inherit that.
    signal.signal(signal.SIGINT, lambda *_: None)
    signal.pthread_sigmask(signal.SIG_SETMASK, set())
    faulthandler.enable(trace, all_threads=False)
    faulthandler.register(signal.SIGUSR1, trace, all_threads=False)
    with Path(os.devnull).open() as nothing:
        os.dup2(nothing.fileno(), 0)  # waiting for the keyboard ends at once
    processes.limit_resources(limits.memory if limits.addresses else math.inf)
    own = os.getpid()

    def tell(item: Any) -> None:  # noqa: ANN401 - JSON
        if os.getpid() != own:
            os._exit(0)  # a copy of this process, which a plug-in forked and let go on
        link.send_bytes(ALIVE if item is None else ITEM + json.dumps(item).encode())

    try:
        while True:
            task: Task = pickle.loads(link.recv_bytes())
            task.carry_out(tell)
            if os.getpid() != own:
                os._exit(0)
            link.send_bytes(DONE)
    except BaseException:  # noqa: BLE001 - the link was cut, or code of users has changed the interpreter
        with contextlib.suppress(BaseException):
            os.write(trace, traceback.format_exc().encode())
    os._exit(1)


def _describe_instant() -> str:
    """Return the addition to a reason that the time of the run makes; empty where no run was carried out."""
    if INSTANT.value == -math.inf:
        return ", before its first period"
    if math.isnan(INSTANT.value):
        return ""
    return f", in the period from {INSTANT.value:.6g} s on"


def _describe_exit(code: int | None) -> str:
    """Return the addition to a reason that an exit code makes."""
    if code is None:
        return ": it cut its link"
    if code >= 0:
        return f": exit code {code}"
    with contextlib.suppress(ValueError):
        return f": {signal.Signals(-code).name}"
    return f": signal {-code}"
