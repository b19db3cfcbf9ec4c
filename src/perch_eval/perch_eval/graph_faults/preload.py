"""Preload for the fork server of these flights: the code of every node and, by a flight in process, the compiled kernels.

The work is done on import, as a fork server can only import modules.
"""

from __future__ import annotations

import importlib

from perch_core.processes import freeze_heap
from perch_eval.in_process import fly
from perch_sim.scenario import load_scenario

for package, name in (
        ("sim", "vehicle"), ("sim", "vio_model"), ("perception", "estimator"), ("planner", "perching_planner"), ("control", "controller"),
        ("control", "mission"), ("core", "description"), ("eval", "modelled_sight"), ("eval", "composed"), ("eval.graph_faults", "relay")):
    importlib.import_module(f"perch_{package}.{name}_node")
fly(load_scenario("surface_90"), 1)
freeze_heap()
