"""Messages that are wrong in one respect each, made from good ones: see `fuzzing.spoiled`."""

from fuzzing.spoiled import kinds

__all__ = ["kinds"]
