"""Preflight check of a vehicle with the props off: the data of its graph are compared with the vehicle file."""
