"""Train, compare and ship controllers for automated vehicles that dissolve stop-and-go waves."""

__version__ = "0.1.0.dev0"
