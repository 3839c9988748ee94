"""The command ``jaxpend``, also as ``python -m jaxpend``."""

# Nothing else is imported here: until ``main`` begins, Ctrl-C is a traceback.
import os
import signal

__all__ = ["main"]


def main() -> None:
    """Run the command line as the program of this process.

    Ctrl-C ends the process at once, in one line. A ``KeyboardInterrupt`` would come up wherever
    the program is: in the middle of an import, or in a callback, where Python prints and drops it.
    Only training waits for a good moment to stop (``train.interrupt``).
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _interrupted)
    for descriptor in range(3):  # one that is closed would be given to the next file that is opened
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    from .cli.app import main

    main()


def _interrupted(signum: int, _frame: object) -> None:
    show_cursor = b"\r\x1b[?25h" if os.isatty(2) else b""
    try:
        os.write(2, show_cursor + b"jaxpend: interrupted\n")  # print may be what is interrupted
    finally:
        os._exit(128 + signum)


if __name__ == "__main__":
    main()
