"""Formulas of car following as pure functions of NumPy arrays, torch tensors and floats, in SI units."""
