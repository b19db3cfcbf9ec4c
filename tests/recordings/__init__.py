"""Recordings made by other means than our renderer, and tests of what is made of them. A package, or `bench/recordings.py` would be found instead."""
