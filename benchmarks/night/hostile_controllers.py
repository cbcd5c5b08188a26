"""Controllers that do to a run whatever code of users may do; `Quiet` does nothing, and is what the others are beside.

The file is given to commands by its place, as a user would give it; each class is a controller.
"""

from __future__ import annotations

import ctypes
import faulthandler
import json
import os
import pickle
import signal
import subprocess
import sys
import time

import numpy as np

from servobench import Command, Controller


class Quiet(Controller):
    """Drives towards nothing in particular, the same in every run of a seed."""

    def __init__(self, knowledge):
        self.n, self.time = knowledge.spec.n, 0.0

    def reset(self, observation, seed):
        self.random = np.random.default_rng(seed)

    def step(self, observation, reference):
        self.time = observation.time
        if self.time > 0.2:
            self.strike()
        return Command(0.05 * self.random.standard_normal(self.n))

    def strike(self):
        """Do harm."""

    def diagnostics(self):
        return {}


class ExitsWhileBuilt(Quiet):
    def __init__(self, knowledge):
        os._exit(3)


class Raises(Quiet):
    def strike(self):
        raise KeyError("gain")


class Unspeakable(Exception):
    def __str__(self):
        raise RuntimeError("no words")


class RaisesUnspeakable(Quiet):
    def strike(self):
        raise Unspeakable


class Leaves(Quiet):
    def strike(self):
        sys.exit(4)


class Interrupts(Quiet):
    def strike(self):
        raise KeyboardInterrupt


class InterruptsItself(Quiet):
    def strike(self):
        os.kill(os.getpid(), signal.SIGINT)


class Exits(Quiet):
    def strike(self):
        os._exit(9)


class Segfaults(Quiet):
    def strike(self):
        ctypes.string_at(0)


class EndsItsParent(Quiet):
    def strike(self):
        os.kill(os.getppid(), signal.SIGKILL)
        time.sleep(60)


class StopsItsParent(Quiet):
    def strike(self):
        os.kill(os.getppid(), signal.SIGSTOP)
        time.sleep(60)


class Forges(Quiet):
    """Answers with a pickled call in place of a result."""

    def strike(self):
        call = f"cos\nsystem\n(S'touch {os.environ.get('FORGED', '')}'\ntR."
        json.dumps = lambda *_, **__: call
        pickle.dumps = lambda *_, **__: call.encode()


class ClosesFiles(Quiet):
    def strike(self):
        faulthandler.disable()
        os.closerange(3, 256)


class Hangs(Quiet):
    def strike(self):
        while True:
            time.sleep(0.001)


class Leaks(Quiet):
    def strike(self):
        kept = []
        while True:
            kept.append(np.ones(2**23))
            time.sleep(0.01)


class LeaksInChild(Quiet):
    """Holds much in several processes, of which none holds too much."""

    def strike(self):
        for _ in range(4):
            if os.fork() == 0:
                kept = np.ones(2**25)
                time.sleep(60 * kept[0])
        time.sleep(60)


class AsksForTooMuch(Quiet):
    def strike(self):
        np.ones(2**38)


class Forks(Quiet):
    """Lets copies of the process go on with the run, as if they were it."""

    def strike(self):
        os.fork()


class LeavesChildren(Quiet):
    """Starts processes that outlive the run, each in a session of its own and with its parent gone."""

    def strike(self):
        if self.time < 0.3:
            leave = "os.fork() and os._exit(0)"
            sleep = f"import os, time; {leave}; os.setsid(); {leave}; time.sleep(300)"
            subprocess.run([sys.executable, "-S", "-c", sleep], check=True)


class HangsWithChildren(LeavesChildren):
    def strike(self):
        super().strike()
        Hangs.strike(self)


class Prints(Quiet):
    def strike(self):
        sys.stdout.write("x" * 2000 + "\n")


class WaitsForKeys(Quiet):
    def strike(self):
        input()


class Lies(Quiet):
    """Leaves a false clock and a false world behind, and answers with something that is no command."""

    def strike(self):
        os.chdir("/")
        np.random.default_rng = lambda seed=None: None
        time.monotonic = time.perf_counter = lambda: 0.0
        sys.setrecursionlimit(60)
        Quiet.step = lambda *_: Command(np.full(99, np.nan))
        raise ValueError("this is fine")


HARMS = (
    Raises, RaisesUnspeakable, Leaves, Interrupts, InterruptsItself, Exits, Segfaults, EndsItsParent, ClosesFiles,
    Hangs, Leaks, LeaksInChild, AsksForTooMuch, Forks, LeavesChildren, Prints, WaitsForKeys,
)  # fmt: skip
HARMED_SHARE = 4  # one run of so many


def harm_of(seed: int) -> type[Quiet] | None:
    """Return what the controller `Sometimes` does to the run that gives it this seed."""
    index = seed % (HARMED_SHARE * len(HARMS))
    return HARMS[index] if index < len(HARMS) else None


class Sometimes(Quiet):
    """Does one harm or another to every fourth run, unless the environment says PEACE."""

    def reset(self, observation, seed):
        super().reset(observation, seed)
        self.harm = None if "PEACE" in os.environ else harm_of(seed)

    def strike(self):
        if self.harm is not None:
            self.harm.strike(self)


class Falsifies(Lies):
    """Lies in every run, unless the environment says PEACE."""

    def strike(self):
        if "PEACE" not in os.environ:
            super().strike()
