"""Messages that are wrong in one respect each, made from good ones: see `perch_eval.fuzz.spoiled`."""

from perch_eval.fuzz.spoiled import kinds

__all__ = ["kinds"]
