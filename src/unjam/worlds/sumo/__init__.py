"""The environment in SUMO. Only this package knows SUMO's files and speed modes."""
