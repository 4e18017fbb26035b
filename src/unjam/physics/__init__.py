"""Formulas of car following: pure, batched, SI units, on NumPy arrays and torch tensors alike."""
