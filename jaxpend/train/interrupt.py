"""Ctrl-C and SIGTERM as a flag that long loops look at between compiled calls.

An exception out of a signal handler may come up anywhere, in a callback of the garbage collector
for one, where Python prints and drops it: the run would go on as if nothing had been said.
"""

import contextlib
import os
import signal
from collections.abc import Callable, Iterator

__all__ = ["Stopped", "deferred", "stop_if_asked"]

_asked: list[int] = []  # the signal that asked the running loops to stop


class Stopped(KeyboardInterrupt):
    """A signal asked to stop, and a loop did, at a place of its own choice."""

    def __init__(self, signum: int, message: str = "interrupted"):
        super().__init__(message)
        self.signum = signum


def _ask(signum, _frame) -> None:
    _asked.append(signum)
    signal.signal(signum, signal.SIG_DFL)  # once more: the end, even inside a compiled call
    show_cursor = "\r\x1b[?25h" if os.isatty(2) else ""
    text = f"{show_cursor}stopping at the end of this step of the loop; once more stops at once\n"
    with contextlib.suppress(OSError):  # not print: the handler may have interrupted one
        os.write(2, text.encode())


@contextlib.contextmanager
def deferred() -> Iterator[None]:
    """Inside, SIGINT and SIGTERM only ask; ``stop_if_asked`` answers. A second one kills.

    One that no loop has answered is answered at the end: it raises ``Stopped`` there. Outside the
    main thread, and for a signal that is ignored (a background job), nothing changes.
    """
    before = {}
    for signum in (signal.SIGINT, signal.SIGTERM):
        if signal.getsignal(signum) not in (signal.SIG_IGN, _ask):
            with contextlib.suppress(ValueError):  # not the main thread
                before[signum] = signal.signal(signum, _ask)
    try:
        yield
    except BaseException:
        if before:
            _asked.clear()
        raise
    finally:
        for signum, handler in before.items():
            signal.signal(signum, handler)
    if before:
        stop_if_asked()


def stop_if_asked(agreed: Callable[[bool], bool] = bool) -> None:
    """Raise ``Stopped`` if a signal came since ``deferred`` began.

    ``agreed`` says whether several processes that loop together stop, given whether this one does.
    """
    if agreed(bool(_asked)):
        signum = _asked[0] if _asked else signal.SIGTERM
        _asked.clear()
        raise Stopped(signum)
