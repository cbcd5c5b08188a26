"""Signals end a command as Ctrl-C does, wherever they meet it, and its temporary files with it."""

import asyncio
import signal
import sys
from collections.abc import Callable

import numpy as np
import pytest

from kit.command import python
from kit.folders import comparison
from servobench.harness.cli.terminal import ending_alike, interrupting_as_usual


class Dropping:
    """An object in whose destructor a signal comes, where Python drops what it raises."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __del__(self) -> None:
        signal.raise_signal(self.number)


class Clearing:
    """An array in whose conversion a signal comes, where numpy clears what it raises."""

    def __init__(self, number: int) -> None:
        self.number = number

    def __len__(self) -> int:
        signal.raise_signal(self.number)
        return 1

    def __getitem__(self, _at: int) -> float:
        raise IndexError


def drop(number: int) -> None:
    """Let a signal come in a destructor."""
    Dropping(number).number = number


def clear(number: int) -> None:
    """Let a signal come amid a function of numpy."""
    np.asarray([Clearing(number)])


def end(number: int, lose: Callable[[int], None], *, waits: bool) -> None:
    """Be a command in which a signal is lost; it waits for another, or ends as if nothing had come."""
    with ending_alike():
        try:
            lose(number)
            while waits:
                signal.pause()
        except KeyboardInterrupt:
            sys.exit(130)
        sys.exit(0)


@pytest.mark.parametrize("waits", [True, False])
@pytest.mark.parametrize("lose", [drop, clear])
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_that_is_lost_ends_the_command(name, lose, waits, capsys):
    number = signal.Signals[name]
    with pytest.raises(SystemExit) as stop:
        end(number, lose, waits=waits)
    assert stop.value.code == 128 + number
    assert "Exception ignored" not in capsys.readouterr().err
    usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
    assert signal.getsignal(number) == usual


def test_signals_that_were_ignored_on_entry_stay_ignored_but_ctrl_c():
    before = {
        number: signal.signal(number, signal.SIG_IGN) for number in (signal.SIGHUP, signal.SIGINT)
    }
    try:
        with ending_alike() as caught:
            signal.raise_signal(signal.SIGHUP)
            assert caught == []
            with pytest.raises(KeyboardInterrupt):
                signal.raise_signal(signal.SIGINT)
            assert caught == [signal.SIGINT]
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


# The command `servobench`, to which a signal comes as soon as it has written a few files.
SIGNALLED = """
import signal, sys
from servobench.harness.apps.exports import exports
from servobench.harness.cli.main import main
name = sys.argv.pop(1)
write, written = exports.write_csv, []
def write_and_meet_a_signal(table, path):
    write(table, path)
    written.append(path)
    if len(written) == 5:
        signal.raise_signal(signal.Signals[name])
exports.write_csv = write_and_meet_a_signal
main()
"""


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP", "SIGINT"])
def test_a_terminated_command_leaves_no_temporary_file_and_nothing_that_looks_whole(name, tmp_path):
    folder = comparison(tmp_path / "folder", tuple(f"c{k}" for k in range(8)), ("exp1",))
    (tmp_path / "temporary").mkdir()
    ended = python(
        "-c", SIGNALLED, name, "export", folder, "--out", tmp_path / "csv",
        TMPDIR=str(tmp_path / "temporary"),
    )  # fmt: skip
    output = ended.stdout + ended.stderr
    assert ended.returncode == 128 + signal.Signals[name], output
    assert output.splitlines()[-1] in ("servobench: terminated", "servobench: interrupted")
    assert sorted(each.name for each in tmp_path.iterdir()) == ["folder", "temporary"]
    assert not any((tmp_path / "temporary").iterdir())


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_a_signal_amid_a_connection_ends_a_server_without_a_trace(name, caplog):
    async def answer(_reader, writer):
        signal.raise_signal(signal.Signals[name])
        writer.close()

    async def serve():
        async with await asyncio.start_server(answer, "127.0.0.1", 0) as server:
            _, writer = await asyncio.open_connection(*server.sockets[0].getsockname())
            try:
                await asyncio.sleep(60.0)
            finally:
                writer.close()

    with pytest.raises(SystemExit), ending_alike(), interrupting_as_usual():
        asyncio.run(serve())
    assert not caplog.records
