"""Faults on the real graph: processes are killed, stopped and restarted, messages are delayed, dropped, duplicated and reordered."""
