"""Where the time of a period goes, as a stacked bar: before, in single runs, and now, in a block of runs side by side.

    python benchmarks/shares.py                              # this checkout
    python benchmarks/shares.py --before /path/to/older --picture shares.png

Functions are wrapped from outside; the time of one that is called within another counts for the inner one only. Each
checkout is measured in a process of its own by the same interpreter.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from measuring import METHODS, PERIODS, WIDTH, resolved_runs, table, write_picture

PARTS = ("plant", "truth", "estimator", "law", "aids", "log", "judging", "building", "rest")
SIDES = {"before": "before, single runs", "single": "now, single runs", "block": "now, side by side"}
Costs = dict[str, dict[str, float]]  # [µs a period] by method and part


class Clock:
    """Processor time by part; of nested parts only the innermost one counts."""

    def __init__(self) -> None:
        """Start with no part."""
        self.spent: dict[str, float] = defaultdict(float)
        self._within: list[str] = ["rest"]
        self._last = time.process_time()

    def switch(self) -> None:
        """Count the time since the last switch for the part that is under way."""
        now = time.process_time()
        self.spent[self._within[-1]] += now - self._last
        self._last = now

    def wrap(self, owner: Any, name: str, part: str) -> None:  # noqa: ANN401 - a class or a module
        """Count a function of `owner` for a part from now on."""
        function: Callable[..., Any] | None = getattr(owner, name, None)
        if function is None or hasattr(function, "part"):
            return

        def timed(*arguments: Any, **named: Any) -> Any:  # noqa: ANN401 - those of the function
            self.switch()
            self._within.append(part)
            try:
                return function(*arguments, **named)
            finally:
                self.switch()
                self._within.pop()

        timed.part = part  # type: ignore[attr-defined]
        setattr(owner, name, timed)


def measure(together: bool, runs: int) -> Costs:
    """Return what each part costs in the checkout that this process imports."""
    from servobench.harness.run import episode, log
    from servobench.harness.run.experiment import build
    from servobench.plant.bench.bench import Bench

    clock, costs = Clock(), {}
    for owner, names, part in (
        (episode, ("build", "build_together"), "building"),
        (episode, ("judge_run", "_judge_together"), "judging"),
        (log.StepLog, ("add", "steps"), "log"),
        (Bench, ("reset", "step"), "plant"),
        (Bench, ("truth",), "truth"),
    ):
        for name in names:
            clock.wrap(owner, name, part)
    for method in METHODS:
        resolved = resolved_runs("kinematic", method, runs)
        controller: Any = build(resolved[0]).controller
        servo = getattr(controller, "servo", controller)
        clock.wrap(type(servo.law), "command", "law")
        if hasattr(servo, "estimation"):
            clock.wrap(type(servo.estimation), "update", "estimator")
            clock.wrap(type(servo.finish), "finish", "aids")
            clock.wrap(type(servo.predictor), "predict", "aids")
        else:  # a checkout before the aids
            for name in ("update", "estimate", "jacobian"):
                clock.wrap(type(servo.estimator), name, "estimator")
        clock.wrap(type(controller), "diagnostics", "log")
        episode.carry_out(resolved[0], steps=False)
        clock.switch()
        clock.spent.clear()
        if together:
            episode.carry_out_together(resolved)
        else:
            for run in resolved:
                episode.carry_out(run, steps=False)
        clock.switch()
        costs[method] = {part: 1e6 * clock.spent[part] / runs / PERIODS for part in PARTS}
    return costs


def measured(checkout: Path, *, together: bool, runs: int) -> Costs:
    """Return the same of another checkout, by a process of its own."""
    command = [sys.executable, __file__, "--child", str(runs), *(["--together"] if together else [])]
    environment = {**os.environ, "PYTHONPATH": str(checkout / ".package"), "OMP_NUM_THREADS": "1"}
    printed = subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout
    costs: Costs = json.loads(printed.splitlines()[-1])
    return costs


def draw(sides: dict[str, Costs], path: Path) -> None:
    """Draw a panel for each side."""
    from servobench.harness.pictures import style

    colours = (
        style.BLUE,
        style.SKY,
        style.VERMILION,
        style.ORANGE,
        style.GREEN,
        style.YELLOW,
        style.PURPLE,
        style.WINE,
        "#BBBBBB",
    )
    with style.figure_style():
        figure = Figure(figsize=(WIDTH, 2.7), layout="constrained")
        for axes, (side, costs) in zip(figure.subplots(1, len(sides), squeeze=False)[0], sides.items(), strict=True):
            left = [0.0] * len(METHODS)
            for part, colour in zip(PARTS, colours, strict=True):
                values = [costs[method][part] for method in METHODS]
                axes.barh(METHODS, values, left=left, color=colour, label=part, height=0.65)
                left = [a + b for a, b in zip(left, values, strict=True)]
            axes.set(title=SIDES[side], xlabel="processor time a period [µs]")
            axes.invert_yaxis()
            axes.label_outer()
            axes.grid(visible=False, axis="y")
        handles, labels = axes.get_legend_handles_labels()
        figure.legend(
            handles, labels, loc="outside lower center", ncols=len(PARTS), handlelength=1.0, columnspacing=1.0
        )
        write_picture(figure, path)


def outlook(costs: Costs) -> str:
    """Return which parts make up most of a million periods over all methods."""
    total = sum(sum(parts.values()) for parts in costs.values()) / len(METHODS)
    largest = sorted(((value / len(METHODS), method, part) for method, parts in costs.items()
                      for part, value in parts.items()), reverse=True)[:5]  # fmt: skip
    learned = sum(parts["estimator"] + parts["law"] for name, parts in costs.items() if name.startswith("rbf"))
    named = ", ".join(f"{part} of `{method}` {value / total:.0%}" for value, method, part in largest)
    return (
        f"Over the five methods a period costs {total:.1f} µs on average, {total / 2:.1f} s a million of them on two "
        f"processors before start-up and writing. The largest shares: {named}. Less than ten seconds needs less than "
        f"20 µs with all of that: estimators and laws of the three methods with networks take "
        f"{learned / len(METHODS):.1f} µs of the average, all the rest {total - learned / len(METHODS):.1f} µs.\n"
    )


def main() -> None:
    """Print a table of the parts, what is largest, and the picture's line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--before", type=Path, help="an older checkout")
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--quick", action="store_true", help="a few runs only, to test the page")
    parser.add_argument("--child", type=int, help=argparse.SUPPRESS)
    parser.add_argument("--together", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.child is not None:
        print(json.dumps(measure(options.together, options.child)))
        return
    here, runs, block = Path(__file__).resolve().parents[1], *((1, 4) if options.quick else (15, 128))
    sides = {"before": measured(options.before, together=False, runs=runs)} if options.before else {}
    sides["single"] = measured(here, together=False, runs=runs)
    sides["block"] = measured(here, together=True, runs=block)
    rows = []
    for side, costs in sides.items():
        for method, parts in costs.items():
            rows.append(
                [SIDES[side], f"`{method}`", *(f"{value:.1f}" for value in (*parts.values(), sum(parts.values())))]
            )
    print(table(["[µs a period]", "method", *PARTS, "sum"], rows))
    print(outlook(sides["block"]))
    if options.picture:
        draw(sides, options.picture)


if __name__ == "__main__":
    main()
