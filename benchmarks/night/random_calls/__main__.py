"""A long campaign: PYTHONPATH=tests:benchmarks python -m night.random_calls --calls 10000000."""

from __future__ import annotations

import tempfile
import time
from itertools import product
from pathlib import Path

from measuring import options
from night.random_calls import arm, build, controller, run

BATCH = 500_000  # calls of one process

calls = (10_000_000, "over both FMUs and both versions together")
chosen = options(__doc__, calls=calls, first=(1, "seed of the first process"))
begin = time.monotonic()
for kind, version in product((arm, controller), (2, 3)):
    made = refused = 0
    seed = chosen.first
    with tempfile.TemporaryDirectory(prefix="servobench-calls-") as folder:
        program = build(Path(folder), kind(version))
        while made < chosen.calls // 4:
            calls, bad = run(program, min(BATCH, chosen.calls // 4 - made), seed)
            made, refused, seed = made + calls, refused + bad, seed + 1
    counts = f"{made} calls, {refused} refused, none found, {time.monotonic() - begin:.0f} s"
    print(f"{kind.__name__}, FMI {version}: {counts}", flush=True)
