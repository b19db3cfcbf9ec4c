"""Campaigns keep their results whatever happens: to the campaign, to a worker, to a Dask worker, to Ctrl-C."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from perch_eval.campaign.command import main
from perch_eval.campaign.results import read_results

HERE = Path(__file__).parent
PATIENCE = 300.0  # only ever waited for in full when a test fails [s]

COMMAND = "import sys; from perch_eval.campaign.command import main; sys.exit(main())"
"""As `scripts/campaign.py`: the command is not the main module, which workers would load."""

CAMPAIGN = """
name: cheap
scenario: surface_90
runs: {runs}
seed: 3
vary:
  wind.gust_sigma: {{uniform: [0.0, 1.0]}}
  target.distance: {{choice: [1.7, 3.0]}}
map: [target.distance, wind.gust_sigma]
"""


@pytest.fixture
def campaign(tmp_path, monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{HERE}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
    monkeypatch.syspath_prepend(HERE)
    monkeypatch.setenv("PERCH_TEST_MARKER", str(tmp_path / "killed"))

    def command(engine: str, runs: int, *options: str) -> list[str]:
        file = tmp_path / "cheap.yaml"
        file.write_text(CAMPAIGN.format(runs=runs))
        return [sys.executable, "-c", COMMAND, str(file), "--engine", f"campaign_engines:{engine}",
                "--jobs", "2", "--out", str(tmp_path / "out"), *options]

    return command


def run(command: list[str]) -> subprocess.CompletedProcess:
    return subprocess.run(command, capture_output=True, text=True, timeout=PATIENCE)


def call(command: list[str], capsys) -> tuple[int, str, str]:
    """Exit code of a command that nobody stops, and what it writes: its workers are processes of their own, it is none."""
    code = main(command[3:])
    return code, *capsys.readouterr()


def refused(command: list[str], capsys) -> str:
    """The message of a command that ends with invalid input, before a worker is started."""
    code, _, words = call(command, capsys)
    assert code == 2
    return words


def numbers(folder: Path) -> list[int]:
    return [r.number for r in read_results(folder / "out" / "results.jsonl")[1]]


def wait_for_results(folder: Path, count: int) -> None:
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            if len(numbers(folder)) >= count:
                return
        except Exception:  # the file or its table is not there yet
            pass
        time.sleep(0.01)
    raise AssertionError(f"no {count} results within {PATIENCE:g} s")


def test_a_killed_campaign_resumes_to_the_200_results_of_an_undisturbed_one(campaign, undrawn, tmp_path, capsys):
    """Though a worker is killed in mid-run after that, too."""
    process = subprocess.Popen(campaign("held", 200), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    wait_for_results(tmp_path, 37)
    workers = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert workers and psutil.wait_procs(workers, timeout=PATIENCE)[1] == []  # none outlives its campaign
    kept = numbers(tmp_path)
    assert 37 <= len(kept) < 200
    (tmp_path / "killed").touch()  # the others may go on
    assert "--resume" in refused(campaign("held", 200), capsys)
    code, again, words = call(campaign("held", 200, "--resume"), capsys)
    assert code == 0, words
    assert numbers(tmp_path) == list(range(200))
    assert f"{200 - len(kept)} of 200 runs to fly" in again
    assert (tmp_path / "killed in run 150").exists()
    found = read_results(tmp_path / "out" / "results.jsonl")[1]
    assert len({r.values["wind.gust_sigma"] for r in found}) == 200 and len({r.seed for r in found}) == 200
    assert all((r.cause == "perched") == (r.values["wind.gust_sigma"] < 0.5) for r in found)
    page = (tmp_path / "out" / "report.html").read_text()
    assert "Causes of failure, ranked" in page and "tilt" in page and "Success over target.distance and wind.gust_sigma" in page


def test_a_worker_that_comes_up_after_the_end_of_its_campaign_ends_too():
    program = ("import multiprocessing, types\n"
               "from perch_eval.campaign.workers import prepare_worker\n"
               "multiprocessing.parent_process = lambda: types.SimpleNamespace(pid=-1)  # not this process's parent any more\n"
               "prepare_worker()\n"
               "print('waits for work')")
    worker = run([sys.executable, "-c", program])
    assert (worker.returncode, worker.stdout, worker.stderr) == (1, "", "")


CLUSTER = """
import sys
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.read()
"""


FORKED = {"DASK_DISTRIBUTED__WORKER__MULTIPROCESSING_METHOD": "forkserver"}
"""Workers are forked from a process that has made Dask's imports."""


@pytest.fixture
def cluster(campaign, tmp_path) -> Iterator[str]:
    """Address of a Dask scheduler with two workers, whose environment gives BLAS four threads."""
    script = tmp_path / "cluster.py"
    script.write_text(CLUSTER)
    with subprocess.Popen([sys.executable, str(script)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                          env=os.environ | {"OPENBLAS_NUM_THREADS": "4", **FORKED}) as process:
        yield process.stdout.readline().strip()
        process.stdin.close()


def test_a_killed_worker_of_a_cluster_loses_no_result_and_all_add_on_one_thread(campaign, undrawn, tmp_path, cluster, capsys):
    code, _, words = call(campaign("mortal", 40, "--cluster", cluster), capsys)
    assert code == 0, words
    assert (tmp_path / "killed").exists()
    assert numbers(tmp_path) == list(range(40))
    found = read_results(tmp_path / "out" / "results.jsonl")[1]
    assert not [r for r in found if r.cause == "error"] and {r.message for r in found} == {"1"}


def test_interrupt_keeps_what_is_finished_and_says_how_to_go_on(campaign, tmp_path):
    process = subprocess.Popen(campaign("held", 200), stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
                               start_new_session=True)
    wait_for_results(tmp_path, 20)
    os.killpg(process.pid, signal.SIGINT)
    _, words = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130
    assert "--resume" in words and "Traceback" not in words
    assert len(numbers(tmp_path)) >= 20
    with pytest.raises(ProcessLookupError):  # nothing of the campaign's process group is left
        for _ in range(round(PATIENCE / 0.05)):
            os.killpg(process.pid, 0)
            time.sleep(0.05)


def test_runs_that_break_are_results_and_do_not_mix_with_those_of_other_settings(campaign, undrawn, tmp_path, capsys):
    assert call(campaign("broken", 12, "--jobs", "1"), capsys)[0] == 1
    found = read_results(tmp_path / "out" / "results.jsonl")[1]
    assert [r.number for r in found if r.cause == "error"] == [0, 4, 8]
    assert "the simulator is out of fuel" in found[0].message
    assert "other settings" in refused(campaign("broken", 13, "--resume"), capsys)


def test_an_unreachable_scheduler_is_invalid_input(campaign, capsys):
    assert "nonsense" in refused(campaign("quick", 5, "--cluster", "nonsense://nowhere"), capsys)
