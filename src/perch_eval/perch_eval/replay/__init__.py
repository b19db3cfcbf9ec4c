"""Recorded flights as animations and plots."""
