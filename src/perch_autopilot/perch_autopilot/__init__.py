"""Autopilots that others wrote: what is said to them, over a link to a vehicle, or to Betaflight's firmware as a program."""
