"""Identification of a vehicle from a flight: lags, delay and gains of its inner loop, thrust, drag."""
