"""Signals that code in between must not lose."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

LOSSES = {
    "a bare except": """
try:
    send()
except BaseException:
    pass
""",
    "a destructor": """
class Temporary:
    def __del__(self):
        send()

Temporary()
""",
    "an extension that clears errors": """
import numpy as np

class Array:
    def __getattribute__(self, name):
        if name == "__array_interface__":
            send()
        return object.__getattribute__(self, name)

np.asarray(Array())
""",
    "an error while a class is defined": """
class Name:
    def __set_name__(self, owner, name):
        send()

try:
    class Owner:
        name = Name()
except Exception:
    pass
""",
}
"""programs that lose an exception of a signal"""
PROGRAM = """
import os, sys, time
from unjam.interruptions import mark_as_handled, raise_signals

def send():
    os.kill(os.getpid(), int(sys.argv[1]))

raise_signals()
try:
    exec(sys.argv[2])
    time.sleep(60)
except BaseException as error:
    mark_as_handled()
    print(type(error).__name__, error.signum, isinstance(error, KeyboardInterrupt), flush=True)
"""
CLEANUP = """
try:
    send()
finally:
    time.sleep(0.5)
    print("clean", flush=True)
"""


def run(signum: int, code: str) -> str:
    command = [sys.executable, "-c", PROGRAM, str(int(signum)), code]
    return subprocess.run(command, capture_output=True, text=True, timeout=50, check=True).stdout


@pytest.mark.parametrize("loss", LOSSES)
def test_a_lost_signal_is_raised_again(loss: str) -> None:
    assert run(signal.SIGTERM, LOSSES[loss]) == "TerminationSignal 15 False\n"
    assert run(signal.SIGINT, LOSSES[loss]) == "InterruptSignal 2 True\n"


def test_a_signal_does_not_interrupt_the_cleanup_after_it() -> None:
    assert run(signal.SIGTERM, CLEANUP) == "clean\nTerminationSignal 15 False\n"


REPEATED_SIGNALS = """
def send_all():
    for signum in (int(sys.argv[1]), 1, 15, 2):
        os.kill(os.getpid(), signum)

try:
    send_all()
finally:
    send_all()
    time.sleep(0.2)
    print("clean", flush=True)
"""


def test_further_signals_do_not_interrupt_the_cleanup() -> None:
    assert run(signal.SIGTERM, REPEATED_SIGNALS) == "clean\nTerminationSignal 15 False\n"


SIGNAL_OF_ANOTHER_THREAD = """
import signal, threading

def send_to_this_thread():
    time.sleep(0.2)
    signal.pthread_kill(threading.get_ident(), int(sys.argv[1]))
    time.sleep(60)

threading.Thread(target=send_to_this_thread, daemon=True).start()
lock = threading.Lock()
lock.acquire()
lock.acquire()
"""


def test_a_signal_that_another_thread_receives_ends_a_wait_for_a_lock() -> None:
    assert run(signal.SIGTERM, SIGNAL_OF_ANOTHER_THREAD) == "TerminationSignal 15 False\n"
    assert run(signal.SIGINT, SIGNAL_OF_ANOTHER_THREAD) == "InterruptSignal 2 True\n"


SIGNAL_OF_A_FORK = """
import signal
if not (child := os.fork()):
    try:
        send()
    finally:
        os._exit(7)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 7
time.sleep(0.5)
print("goes on", flush=True)
os._exit(0)
"""


def test_a_signal_to_a_fork_is_not_one_to_its_parent() -> None:
    assert run(signal.SIGTERM, SIGNAL_OF_A_FORK) == "goes on\n"


def test_an_ignored_signal_stays_ignored() -> None:
    code = "signal.signal(signal.SIGHUP, signal.SIG_IGN); raise_signals(); send(); print('goes on'); sys.exit()"
    program = PROGRAM.replace("import os, sys", "import os, signal, sys").replace("\nraise_signals()\n", "\n")
    command = [sys.executable, "-c", program, str(int(signal.SIGHUP)), code]
    assert subprocess.run(command, capture_output=True, text=True, timeout=50, check=False).stdout == "goes on\n"


@pytest.mark.parametrize(("signum", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
@pytest.mark.parametrize("package", ["numpy", "gymnasium", "typer"])
def test_a_signal_during_imports_ends_a_command_with_one_line(
    signum: signal.Signals, code: int, package: str, tmp_path: Path
) -> None:
    """A package that is imported early sends the signal."""
    code_of_package = f"import os\nos.kill(os.getpid(), {int(signum)})\n"
    (tmp_path / f"{package}.py").write_text(code_of_package)
    command = [sys.executable, "-m", "unjam", "scenarios"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path)}
    found = subprocess.run(command, capture_output=True, text=True, timeout=50, check=False, env=environment)
    word = "interrupted" if signum == signal.SIGINT else "terminated"
    assert (found.returncode, found.stdout, found.stderr) == (code, "", f"unjam: {word}\n")


def test_a_signal_before_a_command_is_found_ends_in_one_line() -> None:
    code = "import os, sys; sys.argv = ['unjam']; from unjam import cli\n"
    code += "cli.exit_with_parent = lambda signum: os.kill(os.getpid(), 15)\n"
    code += "import atexit, time; atexit.register(time.sleep, 0.2); cli.main()"
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=50, check=False)
    assert (found.returncode, found.stdout, found.stderr) == (143, "", "unjam: terminated\n")


def test_an_import_of_the_package_changes_no_signal_handler() -> None:
    code = "import signal; handlers = [*map(signal.getsignal, range(1, 16))]\n"
    code += "import unjam; assert handlers == [*map(signal.getsignal, range(1, 16))]"
    subprocess.run([sys.executable, "-c", code], check=True, timeout=50)
