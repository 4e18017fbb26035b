"""Measures models of drivers on field data: python results/field/field.py FOLDER NGSIM ASTAZERO [WORKERS].

NGSIM and ASTAZERO are tables (.parquet). Under two hours on two cores. It may be stopped and called again: it
goes on where it was. FOLDER gets field.json and field.png, which are copied into results/field/.
"""

import sys
from pathlib import Path

from unjam.studies.field import run

if __name__ == "__main__":
    folder, ngsim, astazero = map(Path, sys.argv[1:4])
    run(folder, ngsim, astazero, workers=int(sys.argv[4]) if len(sys.argv) > 4 else 2, on_progress=print)
