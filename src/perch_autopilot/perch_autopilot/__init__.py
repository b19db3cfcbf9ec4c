"""Interfaces to third-party autopilots: over a link to a vehicle, or to Betaflight's firmware as a program on this machine."""
