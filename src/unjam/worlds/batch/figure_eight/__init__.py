"""Batch simulation of figure eights, with the right of way of SUMO."""
