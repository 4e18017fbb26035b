"""Signals that end the command line, as exceptions that code in between cannot lose.

A bare `except`, a C extension that clears errors, or a destructor can drop an exception that a signal handler raises,
for instance while packages are imported. The command would then run on to its end.
"""

import _thread
import os
import signal
import threading
import time
from collections.abc import Callable
from types import FrameType

SignalHandler = Callable[[int, FrameType | None], None]
RESEND_DELAY = 0.02
"""time after which a lost signal is raised again [s]: it must not be raised within the destructor of its exception"""
_is_handled = False


class _Signal(BaseException):
    """A signal to the process; raised again if the exception is destroyed before `mark_as_handled` is called."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum

    def __del__(self) -> None:
        if not _is_handled:
            _thread.start_new_thread(_raise_again, (self.signum,))


class TerminationSignal(_Signal):
    """The process received SIGTERM, or SIGHUP because its terminal was closed."""


class InterruptSignal(_Signal, KeyboardInterrupt):
    """The process received SIGINT, by Ctrl-C for instance."""


def exit_on_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP end the process with one line, unless they are ignored."""
    _handle_signals(_exit, _exit)


def raise_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP raise an exception in the main thread, unless they are ignored."""
    global _is_handled
    _is_handled = False
    _handle_signals(_interrupt, _terminate)


def mark_as_handled() -> None:
    """Raise no further signal again: the command ends."""
    global _is_handled
    _is_handled = True


def _handle_signals(interrupt: SignalHandler, terminate: SignalHandler) -> None:
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Windows has no SIGHUP, and nohup ignores it
        signum = getattr(signal, name, None)
        if signum is not None and signal.getsignal(signum) != signal.SIG_IGN:
            signal.signal(signum, interrupt if name == "SIGINT" else terminate)


def _exit(signum: int, frame: FrameType | None) -> None:
    word = "interrupted" if signum == signal.SIGINT else "terminated"
    os.write(2, f"unjam: {word}\n".encode())
    os._exit(128 + signum)


def _interrupt(signum: int, frame: FrameType | None) -> None:
    raise InterruptSignal(signum)


def _terminate(signum: int, frame: FrameType | None) -> None:
    raise TerminationSignal(signum)


def _raise_again(signum: int) -> None:
    time.sleep(RESEND_DELAY)
    if _is_handled:
        return
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signum)  # wakes the main thread if it waits
    else:
        _thread.interrupt_main(signal.Signals(signum))
