"""Faults on the real graph: processes killed, stopped or restarted, messages delayed, dropped, duplicated or reordered."""
