"""Policies of other libraries as drivers of this process."""
