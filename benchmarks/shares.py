"""Where the time of a period goes, as a stacked bar: in single runs, and in a block of runs side by side.

    python benchmarks/shares.py --picture shares.png

Functions are wrapped from outside; the time of one that is called within another counts for the inner one only.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from measuring import METHODS, PERIODS, QUICK, WIDTH, options, resolved_runs, table, write_picture
from servobench.harness.apps.figures import style
from servobench.harness.run import episode, log
from servobench.harness.run.experiment import build
from servobench.plant.bench.bench import Bench

COLOURS = {
    "plant": style.COLOURS["blue"], "estimator": style.COLOURS["vermilion"], "law": style.COLOURS["orange"],
    "aids": style.COLOURS["green"], "log, judging": style.COLOURS["yellow"],
    "building": style.COLOURS["wine"], "rest": "#BBBBBB",
}  # fmt: skip
# Functions that all methods share
SHARED = (
    (episode, ("build", "build_together"), "building"),
    (episode, ("judge_run", "_judge_together"), "log, judging"),
    (log.StepLog, ("add", "steps"), "log, judging"),
    (Bench, ("reset", "step", "truth"), "plant"),
)
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


def measure(clock: Clock, runs: int, *, together: bool) -> Costs:
    """Return the cost of each part, in runs by themselves or side by side."""
    costs = {}
    for method in METHODS:
        resolved = resolved_runs("kinematic", method, runs)
        controller: Any = build(resolved[0]).controller
        for owner, name, part in (
            (controller.servo.law, "command", "law"),
            (controller.servo.estimation, "update", "estimator"),
            (controller.servo.finish, "finish", "aids"),
            (controller.servo.predictor, "predict", "aids"),
            (controller, "diagnostics", "log"),
        ):
            clock.wrap(type(owner), name, part)
        episode.carry_out(resolved[0], steps=False)
        clock.switch()
        clock.spent.clear()
        if together:
            episode.carry_out_together(resolved)
        else:
            for run in resolved:
                episode.carry_out(run, steps=False)
        clock.switch()
        costs[method] = {part: 1e6 * clock.spent[part] / runs / PERIODS for part in COLOURS}
    return costs


def draw(sides: dict[str, Costs], path: Path) -> None:
    """Draw a panel for each side."""
    with style.figure_style():
        figure = Figure(figsize=(WIDTH, 2.7), layout="constrained")
        for axes, (side, costs) in zip(figure.subplots(1, len(sides)), sides.items(), strict=True):
            left = [0.0] * len(METHODS)
            for part, colour in COLOURS.items():
                values = [costs[method][part] for method in METHODS]
                axes.barh(METHODS, values, left=left, color=colour, label=part, height=0.65)
                left = [a + b for a, b in zip(left, values, strict=True)]
            axes.set(title=side, xlabel="processor time a period [µs]")
            axes.invert_yaxis()
            axes.label_outer()
            axes.grid(visible=False, axis="y")
        handles, labels = axes.get_legend_handles_labels()
        named = {"ncols": len(COLOURS), "handlelength": 1.0, "columnspacing": 1.0}
        figure.legend(handles, labels, loc="outside lower center", **named)
        write_picture(figure, path)


def main() -> None:
    """Print a table of the parts, and the picture's line."""
    given = options(__doc__, quick=QUICK, picture={"type": Path})
    clock, (runs, block) = Clock(), (1, 4) if given.quick else (15, 128)
    for owner, names, part in SHARED:
        for name in names:
            clock.wrap(owner, name, part)
    sides = {
        "alone": measure(clock, runs, together=False),
        "block": measure(clock, block, together=True),
    }
    rows = [
        [side, f"`{method}`", *(f"{value:.1f}" for value in (*parts.values(), sum(parts.values())))]
        for side, costs in sides.items()
        for method, parts in costs.items()
    ]
    print(table(["[µs a period]", "method", *COLOURS, "sum"], rows))
    if given.picture:
        draw(sides, given.picture)


if __name__ == "__main__":
    main()
