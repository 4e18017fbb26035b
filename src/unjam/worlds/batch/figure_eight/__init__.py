"""Batch simulation of figure eights, with the crossing as SUMO drives it."""
