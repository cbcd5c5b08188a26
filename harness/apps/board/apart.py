"""A run whose controller is in an isolated process of its own, with the limits of foreign code.

    this process                                       isolated process
    plant, loop, log, metrics   -- observation -->     controller, beside the plant of another robot
                                 <-- command --

Code of users is not where the run is made and judged, and the true robot not where the controller is. A controller that
knew more than its observations, or falsified its log, makes another run.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import replace
from multiprocessing.connection import Connection, Pipe
from queue import SimpleQueue
from typing import Any, TypeAlias, final

import numpy as np

from servobench.controllers.controller import Controller, ControllerEntry, Diagnostics
from servobench.harness.apps.board.code import Code
from servobench.harness.apps.board.watch import watch
from servobench.harness.batch.isolation import Tell
from servobench.harness.batch.logs import run_in_folder
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.batch.trials import attempt
from servobench.harness.config.entries import NoSettings, Own
from servobench.harness.config.registry import choose_controller, find_controller, offering
from servobench.harness.config.source import make_importable
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.episode import carry_out
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import careful
from servobench.harness.run.result import RunResult
from servobench.harness.run.variations import Row
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.signals import Command, Observation

DECOY = 1_000_003  # from the seed of a run to that of the other robot
LIMIT = 600.0  # [s] for an answer

Reply: TypeAlias = dict[str, Any]  # JSON values by name
# Asks a method of the isolated controller
Ask = Callable[..., Reply]


@final
class _Remote(Controller):
    """The controller as the run has it."""

    def __init__(self, ask: Ask) -> None:
        self._ask = ask
        self._answer: Reply = {}

    def reset(self, observation: Observation, seed: int) -> None:
        """See `Controller.reset`."""
        self._ask("reset", observation, seed)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`."""
        self._answer = self._ask("step", observation, reference)
        return Command(np.array(self._answer["command"], dtype=np.float64))

    def diagnostics(self) -> Diagnostics:
        """See `Controller.diagnostics`."""
        numbers: Diagnostics = self._answer["diagnostics"]
        return numbers

    def estimated_jacobian(self) -> FloatArray | None:
        """See `Controller.estimated_jacobian`."""
        rows = self._answer["jacobian"]
        if rows is None:
            return None
        return np.array(rows, dtype=np.float64)


def carry_out_apart(folder: ResultsFolder, row: Row, code: Code) -> tuple[RunResult, list[str]]:
    """Carry a run of a folder out again with code of a user.

    Args:
        folder: of results.
        row: of the run in the table of runs.
        code: of its controller.

    Returns:
        The run, and what the code touched that it should not.

    Raises:
        ConfigurationError: the run cannot be made ready here, or its controller cannot be used.
    """
    name = str(row["controller"])
    theirs, ours = Pipe(duplex=False)
    answers: SimpleQueue[Any] = SimpleQueue()
    notices: dict[str, None] = {}

    def hear(told: object) -> None:
        match told:
            case ["notice", str(text)]:
                notices[text] = None
            case _:
                answers.put(told)

    def listen() -> Reply:
        answer: Reply | Future[tuple[Any, str]] = answers.get()
        if isinstance(answer, Future):  # it has ended too early
            _, failure = answer.result()
            raise ConfigurationError(f"controller {name}: {failure}")
        return answer

    def ask(*call: object) -> Reply:
        ours.send(call)
        return listen()

    entry = ControllerEntry(name, "", NoSettings, lambda _config, _knowledge: _Remote(ask))
    asked = theirs.fileno(), folder, row, code
    with ThreadPoolExecutor(1) as thread, closing(ours), closing(theirs):
        end = thread.submit(attempt, _be_controller, *asked, limit=LIMIT, hear=hear)
        end.add_done_callback(answers.put)
        try:
            listen()  # its process, a copy of this one, is there before the true robot is
            with offering([Own("controller", entry, code.place)]):
                result = carry_out(run_in_folder(folder, row, name))
        finally:
            ours.send(None)
    return result, list(notices)


def _be_controller(tell: Tell, link: int, folder: ResultsFolder, row: Row, code: Code) -> None:
    """Answer the calls that come over a link, in the isolated process."""
    calls: Connection[Any, Any] = Connection(link, writable=False)
    watch([code.folder], lambda text: tell(["notice", text]))
    make_importable(code.folder, first=True)
    name = choose_controller(f"{row['controller']}={code.place}")
    if find_controller(name).needs_truth:
        raise ConfigurationError(f"{name} asks for the true robot, as ceilings do")
    run = run_in_folder(folder, row, None, {"controller": name})
    request = replace(run.request, seed=run.request.seed + DECOY)
    decoy = build(replace(run, request=request))
    _, controller = held_to_contract(decoy.plant, decoy.controller)
    tell({})
    with careful():
        while (call := calls.recv()) is not None:
            method, *arguments = call
            tell(_answer(controller, getattr(controller, method)(*arguments)))


def _answer(controller: Controller, command: Command | None) -> Reply:
    """Return the result of a step, and what the log has of the controller, as JSON values; nothing for a reset."""
    if command is None:
        return {}
    estimate = controller.estimated_jacobian()
    rows = None if estimate is None else estimate.tolist()
    numbers = controller.diagnostics().items()
    return {
        "command": command.joint_velocity.tolist(),
        "jacobian": rows,
        "diagnostics": {name: np.asarray(value).item() for name, value in numbers},
    }
