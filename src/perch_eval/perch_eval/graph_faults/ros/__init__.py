"""Observation of the graph by the campaign of faults."""
