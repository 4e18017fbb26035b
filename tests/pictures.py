"""Reports without pictures."""

from contextlib import AbstractContextManager
from unittest.mock import patch


def empty_pictures() -> AbstractContextManager[object]:
    """Leave the pictures of reports empty: drawing takes five seconds, and few tests need them."""
    return patch("unjam.reports.figures.data_uri", lambda figure: "data:image/svg+xml;base64,")
