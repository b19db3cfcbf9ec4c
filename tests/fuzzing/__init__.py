"""Structured nonsense for everything that enters, with an oracle for what sense is. One module per kind, each with `run(minutes, seed, report)`."""
