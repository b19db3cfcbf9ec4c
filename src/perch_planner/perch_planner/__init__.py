"""Perching trajectories: QP with global bound checking, and the powerline NLP."""
