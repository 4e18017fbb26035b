"""Batch simulation of motorways with an on-ramp: the EIDM and lane changes as in SUMO."""
