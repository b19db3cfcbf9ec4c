"""Response of a vehicle to its commands, identified from a flight: lags, delay and gains of its inner loop, thrust, drag."""
