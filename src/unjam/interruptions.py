"""Signals that end the command line, as exceptions in the main thread.

Three things would let a command run on after a signal: code that drops the exception, such as a bare `except`, a C
extension or a destructor; a second signal that interrupts the cleanup after the first; and a signal that the kernel
delivers to another thread while the main thread waits for a lock. Here the first is raised again, the second is
ignored for a moment, and the main thread is woken for the third.
"""

import _thread
import os
import signal
import threading
import time
from collections.abc import Callable
from functools import partial
from types import FrameType

SignalHandler = Callable[[int, FrameType | None], None]
RESEND_DELAY = 0.02
"""time after which a signal is sent again to the main thread [s]: not within the destructor of its exception"""
REPETITION_INTERVAL = 1.0
"""time after a signal in which further signals are ignored [s]: cleanup starts, such as ending other processes"""
MAX_READING_DELAY = 0.2
"""time in which the watching thread reads a signal whose handler has run already [s]"""
_is_handled = False
_raise_time = _handler_time = float("-inf")
"""times of the last signal that raised an exception, and of the last handler, of the clock `time.monotonic` [s]"""


class _Signal(BaseException):
    """A signal to the process; sent again if the exception is destroyed before `mark_as_handled` is called."""

    def __init__(self, signum: int) -> None:
        super().__init__(signum)
        self.signum = signum

    def __del__(self) -> None:
        global _raise_time
        if not _is_handled:
            _raise_time = float("-inf")
            _thread.start_new_thread(_send_again, (self.signum, time.monotonic()))


class TerminationSignal(_Signal):
    """The process received SIGTERM, or SIGHUP because its terminal was closed."""


class InterruptSignal(_Signal, KeyboardInterrupt):
    """The process received SIGINT, by Ctrl-C for instance."""


def exit_on_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP end the process with one line, unless they are ignored."""
    _handle_signals(_exit)


def raise_signals() -> None:
    """Let SIGINT, SIGTERM and SIGHUP raise an exception in the main thread, unless they are ignored."""
    global _is_handled
    _is_handled = False
    _handle_signals(_raise)
    if hasattr(signal, "pthread_kill"):
        reader, writer = os.pipe()
        os.set_blocking(writer, False)
        signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
        os.register_at_fork(after_in_child=partial(signal.set_wakeup_fd, -1))  # signals of a child are not ours
        threading.Thread(target=_wake_main_thread, args=(reader,), daemon=True).start()


def mark_as_handled() -> None:
    """Raise no further signals: the command ends."""
    global _is_handled
    _is_handled = True


def _handle_signals(handler: SignalHandler) -> None:
    for name in ("SIGINT", "SIGTERM", "SIGHUP"):  # Windows has no SIGHUP, and nohup ignores it
        signum = getattr(signal, name, None)
        if signum is not None and signal.getsignal(signum) != signal.SIG_IGN:
            signal.signal(signum, handler)


def _exit(signum: int, frame: FrameType | None) -> None:
    word = "interrupted" if signum == signal.SIGINT else "terminated"
    os.write(2, f"unjam: {word}\n".encode())
    os._exit(128 + signum)


def _raise(signum: int, frame: FrameType | None) -> None:
    global _raise_time, _handler_time
    _handler_time = time.monotonic()
    if _handler_time - _raise_time < REPETITION_INTERVAL:
        return
    if _is_handled:
        os._exit(128 + signum)  # only the exit of the interpreter is left, and takes long
    _raise_time = _handler_time
    raise (InterruptSignal if signum == signal.SIGINT else TerminationSignal)(signum)


def _send_again(signum: int, signal_time: float) -> None:
    """Send a signal to the main thread after `RESEND_DELAY` unless a handler has run since `signal_time`."""
    time.sleep(RESEND_DELAY)
    if _is_handled or _handler_time >= signal_time:
        return
    if hasattr(signal, "pthread_kill"):
        signal.pthread_kill(threading.main_thread().ident or 0, signum)  # ends a wait for a lock, too
    else:
        _thread.interrupt_main(signal.Signals(signum))


def _wake_main_thread(reader: int) -> None:
    """Send each signal of the pipe of `signal.set_wakeup_fd` again if its handler does not run."""
    while signums := os.read(reader, 1):
        if signal.getsignal(signums[0]) is _raise:
            _send_again(signums[0], time.monotonic() - MAX_READING_DELAY)
