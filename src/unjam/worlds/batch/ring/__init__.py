"""Batch simulation of rings: all vehicles of many rings as arrays."""
