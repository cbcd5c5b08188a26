"""Sessions and pages of `servobench play`."""

import contextlib
import socket

from servobench.harness.apps.play.session import Session
from servobench.harness.config.settings import Settings
from servobench.harness.run.loop import careful
from servobench.harness.run.request import RunRequest
from servobench.plant.robot.mismatch import Mismatch


def request(task="circle", mismatch="moderate", seed=1, robot="ur5", **varied):
    return RunRequest(
        "kinematic", "ukf_mfac", task, Mismatch.parse(mismatch), seed, tuple(varied.items()), robot
    )


@contextlib.contextmanager
def session_of(*controllers, settings=None, **chosen):
    with (
        careful(),
        contextlib.closing(
            Session(request(**chosen), controllers, Settings(settings or {}))
        ) as session,
    ):
        yield session


def free_port():
    with socket.create_server(("127.0.0.1", 0)) as trial:
        return trial.getsockname()[1]


@contextlib.contextmanager
def opened_page(*methods, **chosen):
    from servobench.harness.apps.play.guard import open_server
    from servobench.harness.apps.play.page import Page

    port = free_port()
    with careful():
        session = Session(request(**chosen), methods[:1], Settings({}))
        server = open_server("127.0.0.1", port)
        page = Page(server, session, methods, Settings({}))
        try:
            yield page, port
        finally:
            page.session.close()
            server.stop()
