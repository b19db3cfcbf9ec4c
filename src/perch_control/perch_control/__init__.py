"""Geometric and predictive flight control, and the perching mission."""
