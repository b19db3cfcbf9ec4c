"""The first moments of a flight in process."""

from perch_core.scenario import load_scenario
from perch_eval.in_process.engine import Sensing, _Flight
from perch_sim.simulation import START


def test_an_image_exposed_before_the_first_step_ends_is_looked_at():
    flight, middles = _Flight(load_scenario("surface_90_far"), 64, Sensing()), []
    answer = flight.target.answer

    def noted(delivery, *others):
        middles.append(delivery.frame.middle)
        return answer(delivery, *others)

    flight.target.answer = noted
    first = flight.step(False)
    for _ in range(30):
        flight.step(False)
    assert START < middles[0] < first
