"""Run the command line as `python -m unjam`."""

from unjam.cli import main

main()
