"""The worlds of all roads in SUMO. Only this package uses SUMO's input files and speed modes."""
