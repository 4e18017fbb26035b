import unjam  # noqa: F401  (before NumPy: it pins the kernels)
