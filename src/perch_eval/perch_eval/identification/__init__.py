"""What a vehicle answers to its commands, from a flight: lags, delay and gains of its inner loop, thrust, drag."""
