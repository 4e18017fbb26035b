"""Whole rings, many at once, stepped as arrays: what SUMO's episodes of the same seeds do, without SUMO."""
