"""The flight before the flight."""

import os
import subprocess
import sys

import pytest
from perch_control.dry_run import dry_run
from perch_control.modes import State
from perch_control.parameters import ControllerParameters
from perch_core.jit import COMPILED
from perch_core.vehicle import load_vehicle


def run_of(vehicle):
    params = ControllerParameters()
    return dry_run(vehicle, params.gain_set, params.flight)


@pytest.mark.parametrize("name", ["snapdragon", "rpg"])
def test_it_arms_rises_hovers_begins_a_perch_and_lands(name):
    states = run_of(load_vehicle(name))
    assert states[:3] == [State.ARMED, State.HOVERING, State.TRACKING]
    assert states[-1] is State.LANDING


_LOADED_LATER = """
from perch_control.parameters import ControllerParameters
from perch_control.dry_run import dry_run
from perch_core.vehicle import load_vehicle
from numba.core import dispatcher
params, vehicle, loaded = ControllerParameters(), load_vehicle("snapdragon"), []
compile = dispatcher.Dispatcher.compile
def watched(self, signature):
    loaded.append(self.py_func.__name__)
    return compile(self, signature)
dispatcher.Dispatcher.compile = watched
args = vehicle, params.gain_set, params.flight
dry_run(*args)
first = len(loaded)
dry_run(*args)
assert first > 10 and len(loaded) == first, loaded[first:]
"""


@pytest.mark.skipif(not COMPILED, reason="without numba nothing is loaded")
def test_a_second_flight_loads_nothing_more():
    """In a process of its own: here other tests have loaded what it needs."""
    done = subprocess.run([sys.executable, "-c", _LOADED_LATER], env=os.environ, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


def test_nodes_start_without_libraries_that_their_flight_does_not_need():
    nodes = ("perch_sim.vio_model_node", "perch_control.controller_node", "perch_planner.perching_planner_node", "perch_eval.recorder_node",
             *(f"perch_perception.{name}_node" for name in ("estimator", "vio", "target_localizer", "powerline_mapper")))
    program = f"import sys, {', '.join(nodes)}; print(*{{'scipy.optimize', 'scipy.stats', 'osqp', 'matplotlib'}} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", program], check=True, capture_output=True, text=True).stdout.strip() == ""
