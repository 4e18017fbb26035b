"""Reports of results: pages, figures, tables and videos."""
