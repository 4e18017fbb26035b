"""Simulation of many roads at once as arrays, with the same results as SUMO, but without SUMO."""
