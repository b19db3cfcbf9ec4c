"""Messages that are wrong in one respect each, made from good ones: see `fuzzing.spoiled`."""

from fuzzing.spoiled import kinds, plain_ways, spoilt

__all__ = ["kinds", "plain_ways", "spoilt"]
