"""Regeneration of the papers' tables and figures, with a verdict on each value."""
