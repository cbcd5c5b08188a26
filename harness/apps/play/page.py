"""The page of `servobench play`: a session, its scenes and its controls.

Callbacks of viser come in threads of its own. They only leave the name of a control, and the loop here obeys.
"""

import html
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, final

import numpy as np
import viser
from viser import uplot

from servobench.harness.apps.figures.style import method_styles
from servobench.harness.apps.play.scene import PAGE, ArmScene
from servobench.harness.apps.play.session import Session
from servobench.harness.config.settings import Settings
from servobench.harness.run.result import Ending
from servobench.harness.run.tasks import task_names
from servobench.plant.robot.mismatch import Mismatch

ALONE = "nothing"  # in place of a second method
FRAME = 0.04  # [s] between two pictures
TEXTS = 10  # frames from one change of plot and texts to the next


@final
class Page:
    """The page.

    Attributes:
        session: the runs.
        controls: by their names in `page.toml`.
        texts: below them.
    """

    def __init__(
        self,
        server: viser.ViserServer,
        session: Session,
        methods: Sequence[str],
        settings: Settings,
    ) -> None:
        """Fill the page of a server, with the methods to choose from and overrides of defaults."""
        self._server = server
        self._settings = settings
        self._frames = 0
        self._wishes: dict[str, Any] = {}
        self._refusal = ""
        server.gui.configure_theme(show_share_button=False)
        server.initial_camera.position = PAGE["view"]
        self._plot = server.gui.add_uplot((np.zeros(1),) * 2, ({}, {}), **PAGE["plot"])
        choices = {
            "method": {"options": methods},
            "beside": {"options": [ALONE, *methods]},
            "mismatch": {
                "options": dict.fromkeys([str(session.request.mismatch), *PAGE["mismatches"]])
            },
            "task": {"options": dict.fromkeys([session.request.task, *task_names()])},
        }
        self.controls: dict[str, Any] = {}
        for key, row in PAGE["controls"].items():
            given = row["given"] | choices.get(key, {})
            control = getattr(server.gui, row["add"])(row["label"], **given)
            self.controls[key] = control
            if "told" in row:
                getattr(control, row["told"])(partial(self._wishes.__setitem__, key))
        self.texts = server.gui.add_html("")
        self._show(session)

    def _show(self, session: Session) -> None:
        """Draw a session in place of the one before."""
        self.session = session
        self._server.scene.reset()
        names = [side.name for side in session.sides]
        self._scenes = [ArmScene(self._server, index, session) for index in range(len(names))]
        self._target = self._scenes[0].bodies["camera/target"]
        self._target.on_update(partial(self._wishes.__setitem__, "target"))
        styles = method_styles(names)
        lines = [uplot.Series(label=name, stroke=styles[name].colour) for name in names]
        with self._server.atomic():
            self._plot.series = (uplot.Series(label="s"), *lines)
            # Without any number above 0 a logarithmic axis raises an error in the browser.
            self._plot.data = tuple(np.array(session.errors).T)

    def run(self) -> None:
        """Let the runs go on while somebody looks, in real time or as fast as wanted, until Ctrl-C."""
        due = 0.0
        while True:
            began = time.monotonic()
            self.obey()
            if self._server.get_clients():
                due += FRAME * self.controls["speed"].value
            while due >= self.session.period:
                self.session.advance()
                due -= self.session.period
            self.show()
            time.sleep(max(0.0, began + FRAME - time.monotonic()))

    def show(self) -> None:
        """Show the last period, with errors, diagnostics, and why something ended or was refused."""
        for scene in self._scenes:
            scene.show(self.session)
        self._frames += 1
        if self._frames % TEXTS:
            return
        self._plot.data = tuple(np.array(self.session.errors).T)
        texts = html.escape(self._refusal)
        for side in self.session.sides:
            texts += f"<p><b>{side.name}</b> {html.escape(side.reason)}<table>"
            for name, number in side.numbers.items():
                texts += f"<tr><td>{name}<td>{number:.3g}"
            texts += "</table>"
        self.texts.content = PAGE["texts"].format(texts)

    def obey(self) -> None:
        """Do what was wished since the last call; a refusal is shown, and the runs before go on.

        Any error is a refusal, as the code of a user's controller may raise any.
        """
        wished = {self._wishes.popitem()[0] for _ in range(len(self._wishes))}
        if not wished:
            return
        self._refusal = ""
        try:
            if wished - {"target", "knock"}:
                self._begin()
            elif "knock" in wished:
                self.session.knock(np.radians(self.controls["angle"].value))
            else:
                self.session.aim(self._target.position)
        except Exception as error:  # noqa: BLE001
            self._refusal = Ending.of(error).reason

    def _begin(self) -> None:
        """Begin anew as the controls say; where this is refused, the runs before go on."""
        value = {key: control.value for key, control in self.controls.items()}
        request = replace(
            self.session.request,
            mismatch=Mismatch.parse(value["mismatch"]),
            task=value["task"],
            seed=value["seed"],
            varied=tuple((key, size) for key, size in value.items() if "." in key and size),
        )
        names = [value["method"], value["beside"]]
        fresh = Session(request, [name for name in names if name != ALONE], self._settings)
        self.session.close()
        self._show(fresh)
