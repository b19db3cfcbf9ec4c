"""Perception on recordings of real sensors: readers, calibration files, the components run over them, checks and reports."""
