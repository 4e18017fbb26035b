"""Run the command line in forks of a process that has imported all packages.

An interpreter that imports torch needs four seconds before it reads its arguments. This program reads one request
per line from standard input, and prints the exit code.
"""

import json
import os
import signal
import sys
import traceback
from contextlib import nullcontext

import unjam.cli
import unjam.cli.output
import unjam.training.evaluate
import unjam.training.model_facts
import unjam.training.train
from tests.pictures import empty_pictures

MAX_SECONDS = 300
"""[s]"""


def run(arguments: list[str], folder: str, out: str, errors: str, pictures: bool) -> None:
    """Become `unjam` with these arguments, with or without figures in reports; never returns."""
    signal.alarm(MAX_SECONDS)
    os.chdir(folder)
    for path, stream in ((out, 1), (errors, 2)):
        os.dup2(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    sys.argv = ["unjam", *arguments]
    sys.path[0] = str(os.path.dirname(sys.executable))
    code = 1
    try:
        with nullcontext() if pictures else empty_pictures():
            unjam.cli.main()
    except SystemExit as end:
        code = end.code if isinstance(end.code, int) else int(end.code is not None)
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


def main() -> None:
    """Run requests until the end of standard input."""
    for line in sys.stdin:
        child = os.fork()
        if child == 0:
            run(**json.loads(line))
        _, status = os.waitpid(child, 0)
        print(os.waitstatus_to_exitcode(status), flush=True)


if __name__ == "__main__":
    main()
