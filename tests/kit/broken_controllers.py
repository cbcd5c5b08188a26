"""Controllers with one defect each, the check that finds it, and the line that says so."""

# ruff: noqa: E501 - a case a line

from kit.own import WHOLE

STEP = "        return servobench.Command(np.zeros(self.n))\n"
HEAD = "import ctypes, itertools, os, random, sys, time\nfrom numpy.random import default_rng\n"
BODY = HEAD + WHOLE  # so that line numbers are those of WHOLE + 2


def stepping(*lines: str, reset: str = "pass", module: str = "", inside: str = "") -> str:
    """Return a file whose `step` has these lines, `reset` this one, the class these attributes."""
    text = BODY.replace(STEP, "".join(f"        {line}\n" for line in lines))
    text = text.replace("seed):\n        pass", f"seed):\n        {reset}")
    return text.replace('"""Does not move."""', f'"""Does not move."""{inside}') + module


COMMAND = "return servobench.Command(np.{} * np.ones(self.n))"
BROKEN = {  # file, check, begin of its line
    "array": (stepping("return np.zeros(self.n)"), "command", "mine.py:17: step must return a Command, got ndarray of shape (6,); write `return Command("),
    "complex": (stepping("return servobench.Command(1j * np.zeros(self.n))"), "command", "mine.py:18: ValueError: joint_velocity must be real numbers, got complex128"),
    "numbers as texts": (stepping("return servobench.Command(np.array(['1'] * self.n))"), "command", "mine.py:18: ValueError: joint_velocity must be real numbers, got <U1"),
    "masked": (stepping("return servobench.Command(np.ma.masked_all(self.n))"), "command", "mine.py:18: ValueError: joint_velocity must be numbers, got a masked array; write .filled(value)"),
    "nan": (stepping(COMMAND.format("nan")), "command", "mine.py:18: ValueError: joint_velocity must be finite, got [nan"),
    "scalar": (stepping("return servobench.Command(0.0)"), "command", "mine.py:18: ValueError: joint_velocity must have shape (n,)"),
    "degrees": (stepping("self.J(np.degrees(observation.joint_position))", STEP.strip()).replace("self.n = knowledge.spec.n", "self.n, self.J = knowledge.spec.n, knowledge.nominal_jacobian"), "command", "mine.py:17: nominal_jacobian is called with 19.3; joint"),
    "huge": (stepping("return servobench.Command(np.full(self.n, 1e9))"), "limits", "mine.py:17: a command is 1e+09 times the joint-speed limit; shorten it"),
    "a little too fast": (stepping("return servobench.Command(np.full(self.n, 1.01))"), "limits", "mine.py:17: a command is 1.01 times the joint-speed limit"),
    "exception in step": (stepping("return observation.joints"), "command", "mine.py:18: AttributeError: 'Observation' object has no attribute 'joints'"),
    "exception later": (stepping("self.k += 1", "if self.k > 9: raise RuntimeError('late')", STEP.strip(), reset="self.k = 0"), "command", "mine.py:19: RuntimeError: late"),
    "exception in reset": (stepping(STEP.strip(), reset="self.y = {}['y']"), "command", "mine.py:15: KeyError: 'y'"),
    "division": (stepping("u = np.ones(self.n) / (0.0 * observation.feature[0])", "return servobench.Command(u)"), "command", "mine.py:18: FloatingPointError: divide by zero encountered in divide; such a number ends a run"),
    "writes into the feature": (stepping("observation.feature[:] = 0.0", STEP.strip()), "command", "mine.py:18: ValueError: assignment destination is read-only; the arguments of step must not be changed"),
    "writes into the reference": (stepping("reference -= 1.0", STEP.strip()), "command", "mine.py:18: ValueError: output array is read-only; the arguments of step must not be changed"),
    "writes by force": (stepping("reference.flags.writeable = True", "reference[0] = 0.0", STEP.strip()), "command", "mine.py:17: step changes its arguments; work on a copy"),
    "exit": (stepping("sys.exit(3)"), "command", "mine.py:18: SystemExit: 3; raise an error instead"),
    "exception in diagnostics": (BODY.replace("return {}", "return {'a': self.a}"), "diagnostics", "mine.py:21: AttributeError: 'Mine' object has no attribute 'a'"),
    "no names in diagnostics": (BODY.replace("return {}", "return [1.0]"), "diagnostics", "mine.py:20: diagnostics must return a mapping of names to numbers, got list; write `return {}`"),
    "wrong Jacobian": (BODY + "\n    def estimated_jacobian(self):\n        return np.zeros((2, 2))\n", "diagnostics", "mine.py:23: estimated_jacobian must return an array of shape (3, 6) or None, got ndarray of shape (2, 2)"),
    "writes past the flag": (stepping("ctypes.memset(reference.ctypes.data, 0, reference.nbytes)", STEP.strip()), "command", "mine.py:17: step changes its arguments; work on a copy"),
    "unseeded generator": (stepping("return servobench.Command(self.rng.uniform(-1, 1, self.n))", reset="self.rng = default_rng()"), "repeatable", "mine.py:15: a generator of random numbers is made without a seed; make one in reset"),
    "numpy's generator": (stepping("return servobench.Command(np.random.uniform(-1, 1, self.n))"), "repeatable", "it draws from the generator of numpy.random"),
    "Python's generator": (stepping("return servobench.Command(np.full(self.n, random.random()))"), "repeatable", "it draws from the generator of random,"),
    "clock": (stepping("return servobench.Command(np.full(self.n, time.perf_counter() % 1.0))"), "repeatable", "two new controllers command differently with the same seed: it depends on the clock"),
    "module variable": (stepping("return servobench.Command(np.full(self.n, 1.0 / (1 + next(COUNT))))", module="\n\nCOUNT = itertools.count()\n"), "repeatable", "two new controllers command differently with the same seed"),
    "forgets nothing": (stepping("self.k = getattr(self, 'k', 0) + 1", "return servobench.Command(np.full(self.n, 1.0 / self.k))"), "reset", "mine.py:14: reset keeps values of an earlier run in self.k; set it anew there"),
    "integral is kept": (stepping("self.total = self.total + 0.01", "return servobench.Command(np.full(self.n, self.total))").replace("        self.n =", "        self.total = 0.0\n        self.n ="), "reset", "mine.py:15: reset keeps values of an earlier run in self.total"),
    "shared but reset": (stepping("STATE['k'] += 1", "return servobench.Command(np.full(self.n, 1.0 / STATE['k']))", reset="STATE['k'] = 0", module="\n\nSTATE = {'k': 0}\n"), "separate", "two controllers in one process disturb each other"),
    "shared among others": (stepping("Mine.y = Mine.y if self.k else reference[0]", "self.k += 1", "return servobench.Command(np.full(self.n, 0.1 * Mine.y[0]))", reset="self.k = 0", inside="\n    y = None"), "separate", "two controllers in one process disturb each other through a variable of the module or the class, y;"),
    "kept from the first": (stepping("FIRST.setdefault(self.n, observation.feature[0])", "return servobench.Command(np.full(self.n, 0.1 * FIRST[self.n]))", module="\n\nFIRST = {}\n"), "separate", "two controllers in one process disturb each other through a variable of the module or the class, FIRST;"),
    "saves too little": (stepping("self.k += 1", "return servobench.Command(np.full(self.n, 1.0 / self.k))", reset="self.k = 0", module="\n    def save(self):\n        return None\n\n    def restore(self, state):\n        pass\n"), "save", "after restore it commands differently"),
    "error over its norm": (stepping("e = reference[0] - observation.feature", "return servobench.Command(np.full(self.n, 0.1 * (e / np.linalg.norm(e))[0]))"), "at target", "mine.py:19: FloatingPointError: invalid value encountered in divide"),
    "refuses a lost feature": (stepping("assert observation.feature_valid", STEP.strip()), "lost feature", "mine.py:18: AssertionError"),
    "refuses a later loss": (stepping("self.k += 1", "assert observation.feature_valid or self.k < 9", STEP.strip(), reset="self.k = 0"), "lost feature", "mine.py:19: AssertionError"),
    "a hundred rows": (stepping("self.log[self.k] = 1.0", "self.k += 1", STEP.strip(), reset="self.k, self.log = 0, np.zeros(100)"), "approach", "mine.py:18: IndexError: index 100 is out of bounds for axis 0 with size 100; this happens with a period of 20 ms"),
    "overflow": (stepping("return servobench.Command(np.full(self.n, 1.0 / np.exp(np.max(np.abs(observation.feature)))))"), "large numbers", "mine.py:18: FloatingPointError: overflow"),
    "six joints": (stepping("return servobench.Command(np.zeros(6))"), "other sizes", "mine.py:17: step must return a Command of shape (7,), one rad/s a joint, got (6,); this happens with 7 joints and 2 features"),
    "three features": (stepping("return servobench.Command(np.full(self.n, 0.0 * observation.feature[2]))"), "other sizes", "mine.py:18: IndexError: index 2 is out of bounds for axis 0 with size 2; this happens with 7 joints and 2 features"),
    "slow": (stepping("time.sleep(0.06)", STEP.strip()), "time", "a step takes "),
    "constructor": (BODY.replace("knowledge.spec.n", "knowledge.n"), "constructor", "mine.py:12: AttributeError: 'RobotKnowledge' object has no attribute 'n'"),
}  # fmt: skip
NOTED = {
    "printing": (stepping("print('step')", STEP.strip()), "output", "it prints 24 lines in 24 steps"),
    "refuses sizes": (BODY.replace("        self.n = knowledge.spec.n", "        self.n = knowledge.spec.n\n        if self.n != 6:\n            raise ValueError('six joints are needed')"), "other sizes", "it refuses 7 joints and 2 features: mine.py:14: ValueError: six joints are needed"),
    "looks ahead": (stepping("return servobench.Command(np.full(self.n, 0.0 * reference[1, 0]))"), "no preview", "it needs a preview of the reference, run.preview_time"),
    "wrong sign": (stepping("e = observation.feature - reference[0]", "u = self.J(observation.joint_position).T @ e", "return servobench.Command(np.clip(u, -1.0, 1.0))").replace("        self.n =", "        self.J = knowledge.nominal_jacobian\n        self.n ="), "approach", "on a made-up arm the error grows"),
    "a lock": (stepping(STEP.strip(), reset="import threading; self.lock = threading.Lock()"), "save", "it cannot be saved and continued in several ways: TypeError: cannot pickle"),
    "slow now and then": (stepping("self.k += 1", "time.sleep(0.06 * (self.k == 9))", STEP.strip(), reset="self.k = 0"), "time", "a step took "),
}  # fmt: skip
