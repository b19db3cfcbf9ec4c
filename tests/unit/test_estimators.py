"""The registry of estimators: the parameter `type` of the node `estimator` chooses among them, in process and over ROS."""

import re
from pathlib import Path

import pytest
import rclpy
from perch_core.errors import ConfigError
from perch_eval.in_process.parameters import NodeParameters
from perch_perception.estimator_component import StateEstimator
from perch_perception.estimator_node import create
from perch_perception.estimators import ESTIMATORS, estimator_class
from perch_sim.scenario import load_scenario

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "howto" / "own_estimator.md"


@pytest.fixture
def mine(tmp_path, monkeypatch):
    """The estimator of the guide, in the registry."""
    text = re.search(r"```py\n# (\S+)\n(.*?)```", GUIDE.read_text(), re.S)
    (tmp_path / text.group(1)).write_text(text.group(2))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setitem(ESTIMATORS, "complementary", "complementary:Complementary")


def scenario(tmp_path, parameters):
    file = tmp_path / "mine.yaml"
    file.write_text(f"name: mine\nextends: surface_90\nparameters: {{estimator: {parameters}}}\n")
    return load_scenario(file)


def test_the_filter_of_the_paper_is_the_default(tmp_path):
    parameters = NodeParameters(scenario(tmp_path, "{coasting_after: 0.3}"), 1)
    assert type(parameters.component("estimator")) is StateEstimator is estimator_class("ukf")


def test_another_one_takes_its_own_parameters_in_process(mine, tmp_path):
    component = NodeParameters(scenario(tmp_path, "{type: complementary, pull: 0.25}"), 1).component("estimator")
    assert (type(component).__name__, component.config.pull) == ("Complementary", 0.25)
    with pytest.raises(ConfigError, match="pull"):
        NodeParameters(scenario(tmp_path, "{type: complementary, pull: 2.5}"), 1).component("estimator")


def test_another_one_takes_its_own_parameters_as_a_node(mine, ros_domain):
    rclpy.init(args=[])
    try:
        node = create(cli_args=["--ros-args", "-p", "type:=complementary", "-p", "pull:=0.25"], use_global_arguments=False)
        assert type(node.component).__name__ == "Complementary"
        assert (node.get_parameter("type").value, node.get_parameter("pull").value) == ("complementary", 0.25)
        node.close(), node.destroy_node()
        for wrong, words in (("mine", "estimator: type: 'mine' is not one of ukf, complementary"), ("3", "estimator: type: 3 is not of type str")):
            with pytest.raises(ConfigError, match=words):
                create(cli_args=["--ros-args", "-p", f"type:={wrong}"], use_global_arguments=False)
    finally:
        rclpy.try_shutdown()
