"""Inspection of powerlines [P:VI-A]: layouts, flights and measures."""
