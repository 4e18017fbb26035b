"""Batch simulation of motorways with an on-ramp, with the EIDM and the lane changes of SUMO."""
