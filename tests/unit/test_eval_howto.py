"""What the how-to guides show is valid: files load, commands are accepted, the Python examples fly."""

import re
import shlex
from pathlib import Path
from unittest.mock import patch

import pytest
import action
import param
import service
import start_stack
import topic
from perch_autopilot import command as betaflight
from perch_control.laws import LAWS
from perch_control.mission.missions import MISSIONS
from perch_core.tag_board import load_board
from perch_eval import comparison, demo, soak
from perch_eval.campaign import command as campaign
from perch_eval.campaign.specification import load_campaign
from perch_eval.evaluation import command as evaluation
from perch_eval.graph_faults import campaign as faults
from perch_eval.identification import command as identify
from perch_eval.preflight import command as preflight
from perch_eval.recordings import command as perceive
from perch_eval.recordings import sensors_command
from perch_eval.replay import command as replay
from perch_perception.estimators import ESTIMATORS
from perch_sim.scenario import load_scenario

GUIDES = sorted((Path(__file__).resolve().parents[2] / "docs" / "howto").glob("*.md"))
LOADERS = {"scenario": load_scenario, "board": load_board, "campaign": load_campaign}
PARSERS = {"demo.py": demo.parser, "campaign.py": campaign.parser, "evaluate.py": evaluation.parser, "replay.py": replay.parser,
           "start_stack.py": start_stack.command_line, "perceive.py": perceive.parser, "sensors.py": sensors_command.parser, "faults.py": faults.parser,
           "soak.py": soak.parser, "compare.py": comparison.parser, "action.py": action.command_line, "topic.py": topic.command_line,
           "service.py": service.command_line, "param.py": param.command_line, "identify.py": identify.parser, "preflight.py": preflight.parser,
           "betaflight.py": betaflight.parser}
WITHOUT_PARSER = {"bench.py", "plan.py", "setup.py", "test.py"}
"""Scripts of the documentation whose parser exists only while they run."""
ROOT = GUIDES[0].parents[2]


def _code():
    """Pages of README and docs with their code, and in it what follows a backslash at the end of a line."""
    for page in (ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))):
        code = "\n".join(re.findall(r"^ *```(?:bash)?\n(.*?)^ *```", page.read_text(), re.S | re.M)).replace("\\\n", " ")
        yield page, re.sub(r"(?m) # .*$", "", code)


def _commands():
    """Commands with a parser in the code of README and docs."""
    for page, code in _code():
        for line in re.findall(r"^ *(?:nice -n \d+ )?python3 scripts/(\w+\.py(?:'[^']*'|[^'\n])*)", code, re.M):
            script, *arguments = shlex.split(line)
            if script in PARSERS and not any("..." in argument or argument.isupper() for argument in arguments):
                yield pytest.param(script, arguments, id=f"{page.stem}: {line[:60]}")


def blocks(language):
    return list(_blocks(language))


def _blocks(language):
    for guide in GUIDES:
        for k, text in enumerate(re.findall(rf"```{language}\n(.*?)```", guide.read_text(), re.S)):
            yield pytest.param(text, id=f"{guide.stem}-{k}")


@pytest.mark.parametrize("text", blocks("yaml"))
def test_files_load(text, tmp_path):
    kind, name = re.match(r"# (\w+) (\S+)", text).groups()
    file = tmp_path / name
    file.write_text(text)
    LOADERS[kind](file)


def test_no_example_is_left_out():
    """Without one, the tests of examples would be skipped; and a script that nobody knows here would be tried by none."""
    named = [name for _, code in _code() for name in re.findall(r"python3 scripts/(\w+\.py)", code)]
    assert set(named) - set(PARSERS) == WITHOUT_PARSER
    assert len(list(_commands())) >= 0.9 * sum(name in PARSERS for name in named) > 40  # but for those with an ellipsis
    fences = "".join(guide.read_text() for guide in GUIDES)
    assert len(blocks("yaml")) == fences.count("```yaml") >= 8 and len(blocks("python")) == fences.count("```python") >= 4


@pytest.mark.parametrize("script, arguments", list(_commands()))
def test_commands_are_accepted(script, arguments):
    PARSERS[script]().parse_args(arguments)


@pytest.mark.parametrize("text", blocks("python"))
@pytest.mark.slow
def test_python_runs(text, tmp_path, monkeypatch, capsys):
    guide = next(g for g in GUIDES if text in g.read_text())
    for yaml in re.findall(r"```yaml\n(.*?)```", guide.read_text(), re.S):
        (tmp_path / re.match(r"# \w+ (\S+)", yaml).group(1)).write_text(yaml)
    for module in re.findall(r"```py\n(.*?)```", guide.read_text(), re.S):
        (tmp_path / re.match(r"# (\S+)", module).group(1)).write_text(module)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    with patch.dict(LAWS), patch.dict(ESTIMATORS), patch.dict(MISSIONS):  # guides add to them
        exec(compile(text, guide.name, "exec"), space := {})
    assert capsys.readouterr().out.split()[0] in ("perched", "missed")
    if guide.stem == "own_mission":
        assert space["trace"].outcome == "perched" and any("going nearer" in message for _, _, message in space["trace"].phases)


def test_stacks_that_start_in_the_same_second_have_logs_of_their_own(monkeypatch):
    monkeypatch.setattr(start_stack.time, "strftime", lambda _: "20260101-120000")
    folders = []
    for process in (1, 2):
        monkeypatch.setattr(start_stack.os, "getpid", lambda: process)  # noqa: B023 (called in this turn)
        folders.append(start_stack.default_log_folder())
    assert folders[0] != folders[1]
