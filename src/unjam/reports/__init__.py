"""Metrics, statistics, pictures, the report: what is said of results."""
