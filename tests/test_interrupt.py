"""Signals that ask, and loops that answer."""

import contextlib
import gc
import os
import pty
import signal
import subprocess
import sys

import pytest

from jaxpend.train.interrupt import Stopped, deferred, stop_if_asked


@pytest.fixture(autouse=True)
def _usual_handlers():
    """As in a shell's foreground, and put back."""
    handlers = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: signal.SIG_DFL}
    before = {signum: signal.signal(signum, handler) for signum, handler in handlers.items()}
    yield
    for signum, handler in before.items():
        signal.signal(signum, handler)


@pytest.mark.parametrize("signum", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_is_answered_where_the_loop_looks(capfd, signum):
    with deferred():
        stop_if_asked()
        os.kill(os.getpid(), signum)
        assert "once more stops at once" in capfd.readouterr().err
        with pytest.raises(Stopped) as stop:
            stop_if_asked()
    assert stop.value.signum == signum
    stop_if_asked()  # what was asked of one loop does not stop the next
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


def test_a_signal_in_a_callback_of_the_garbage_collector_is_not_lost(capfd):
    def callback(phase, _):
        if phase == "start":
            os.kill(os.getpid(), signal.SIGINT)
            gc.callbacks.remove(callback)

    with deferred():
        gc.callbacks.append(callback)
        gc.collect()
        with pytest.raises(Stopped):
            stop_if_asked()


def test_a_signal_that_no_loop_has_answered_is_not_lost(capfd):
    """It came after the last look: what follows must not go on as if nothing had been said."""
    with pytest.raises(Stopped), deferred():
        os.kill(os.getpid(), signal.SIGINT)
    with deferred():
        stop_if_asked()
    with pytest.raises(ZeroDivisionError), deferred():  # what went wrong comes first
        os.kill(os.getpid(), signal.SIGINT) or 1 / 0
    stop_if_asked()


def test_an_ignored_signal_stays_ignored():
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with deferred():
        os.kill(os.getpid(), signal.SIGINT)
        stop_if_asked()
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN


def test_a_second_signal_kills():
    code = """
import os, signal
from jaxpend.train.interrupt import deferred
signal.signal(signal.SIGINT, signal.default_int_handler)
with deferred():
    os.kill(os.getpid(), signal.SIGINT)
    print("asked", flush=True)
    os.kill(os.getpid(), signal.SIGINT)
    print("not reached", flush=True)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (-signal.SIGINT, "asked\n")


def test_an_interrupted_progress_bar_leaves_the_cursor_on():
    code = """
import os, signal, time
from jaxpend.train.interrupt import Stopped, deferred, stop_if_asked
from jaxpend.terminal import LiveProgress
signal.signal(signal.SIGINT, signal.default_int_handler)
try:
    with deferred(), LiveProgress("SAC", 3) as progress:
        progress.report(1, "note")
        os.kill(os.getpid(), signal.SIGINT)
        stop_if_asked()
except Stopped:
    os._exit(130)
"""
    ours, theirs = pty.openpty()
    environment = os.environ | {"TERM": "xterm"}
    line = [sys.executable, "-c", code]
    with subprocess.Popen(line, stdin=theirs, stdout=theirs, stderr=theirs, env=environment) as p:
        os.close(theirs)
        said = b""
        with contextlib.suppress(OSError):  # the end of a terminal
            while more := os.read(ours, 4096):
                said += more
        os.close(ours)
    assert p.returncode == 130
    assert b"once more stops at once" in said
    assert -1 < said.rindex(b"\x1b[?25l") < said.rindex(b"\x1b[?25h")


def test_a_signal_is_answered_where_standard_error_is_closed(monkeypatch):
    monkeypatch.setattr("sys.stderr", None)
    with deferred():
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Stopped):
            stop_if_asked()
