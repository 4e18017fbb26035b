"""Benchmarks that anyone can enter: suites of roads with fixed test seeds, results and leaderboards."""
