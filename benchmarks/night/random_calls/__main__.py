"""A long campaign: PYTHONPATH=tests:benchmarks python -m night.random_calls --calls 10000000."""

from __future__ import annotations

import argparse
import sys
import tempfile
import time
from itertools import product
from pathlib import Path

from night.random_calls import arm, build, controller, run

BATCH = 500_000  # calls of one process

options = argparse.ArgumentParser(description=__doc__)
options.add_argument("--calls", type=int, default=10_000_000, help="over both FMUs and both versions together")
options.add_argument("--first", type=int, default=1, help="seed of the first process")
chosen = options.parse_args()
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
    sys.stdout.write(f"{kind.__name__}, FMI {version}: {counts}\n")
    sys.stdout.flush()
