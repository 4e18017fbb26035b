"""Measures Fig. 6 anew: python results/figure-6/figure_6.py FOLDER [WORKERS [REPEATS]].

Under half an hour on two cores. It may be stopped and called again: it goes on where it was. FOLDER gets
figure-6.json and figure-6.png, which are copied into results/figure-6/.
"""

import sys
from pathlib import Path

from unjam.studies.figure_6 import REPEATS, run

if __name__ == "__main__":
    workers, repeats = [*map(int, sys.argv[2:]), *(2, REPEATS)[len(sys.argv) - 2 :]]
    run(Path(sys.argv[1]), workers, print, repeats)
