"""`python -m unjam` is `unjam`."""

from unjam.cli import main

main()
