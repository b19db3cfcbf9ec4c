"""What a soak takes for growth."""

from __future__ import annotations

import os
from contextlib import contextmanager, nullcontext
from types import SimpleNamespace

import pytest
from perch_eval import soak


def flights(memory, descriptors=lambda k: 10, good=lambda k: True, shared=lambda k: 1.0):
    return [soak.Flight(float(k), "perched" if good(k) else "missed", good(k), "", {"all": soak.Sample(memory(k), descriptors(k), 5)},
                        shared(k))
            for k in range(150)]


def test_what_grows_is_found():
    assert soak.find_problems(flights(lambda k: 100.0 + min(k, 50))) == []  # what grows at first only
    assert soak.find_problems(flights(lambda k: 100.0 + 0.02 * k)) == ["all: memory grows by 2.00 MB per 100 flights"]
    assert soak.find_problems(flights(lambda k: 100.0, lambda k: 10 + (k > 140))) == ["all: descriptors between 10 and 11"]
    assert soak.find_problems(flights(lambda k: 100.0, shared=lambda k: 1.0 + 0.03 * k)) == ["/dev/shm grows by 3.00 MB per 100 flights"]
    assert soak.find_problems(flights(lambda k: 100.0, good=lambda k: k != 7)) == ["flight 8: missed, no departure: "]


def test_a_slope_needs_flights():
    assert soak.slope([1.0] * 60) is None
    assert soak.slope([0.5 * k for k in range(200)]) == pytest.approx(50.0)


@pytest.mark.parametrize("flown, judged", [(10, False), (69, False), (70, True)])
def test_a_soak_that_is_too_short_for_growth_says_so(tmp_path, monkeypatch, capsys, flown, judged):
    def fly(*arguments):
        return flights(lambda k: 100.0)[:flown]

    monkeypatch.setattr(soak, "fly", fly)
    monkeypatch.setattr(soak, "plot", lambda _, file: file.touch())
    assert soak.main(["--out", str(tmp_path), "--logs", str(tmp_path)]) == 0
    for text in (capsys.readouterr().out.lower(), (tmp_path / "README.md").read_text().lower()):
        assert ("too few flights" in text) is (f"too few flights to judge growth of memory: {flown}, 70 are needed" in text) is not judged


def test_a_process_is_sampled():
    before = soak.sample(os.getpid())
    with open(os.devnull):
        after = soak.sample(os.getpid())
    assert after.descriptors == before.descriptors + 1 and before.rss > 1.0 and before.threads >= 1


def test_what_was_flown_before_a_soak_was_killed_is_kept(tmp_path, monkeypatch):
    class Killed(BaseException):
        """As a signal that nothing stops."""

    def fly(*arguments):
        keep = arguments[-1]
        keep(flights(lambda k: 100.0)[:20])
        raise Killed

    monkeypatch.setattr(soak, "fly", fly)
    monkeypatch.setattr(soak, "plot", lambda _, file: file.touch())
    monkeypatch.setattr("sys.argv", ["scripts/soak.py", "--out", str(tmp_path)])
    with pytest.raises(Killed):
        soak.main(["--out", str(tmp_path), "--logs", str(tmp_path)])
    page = (tmp_path / "README.md").read_text()
    assert "20 of 20 flights perched and departed" in page and f"Made by `python3 scripts/soak.py --out {tmp_path}` on " in page
    assert (tmp_path / "surface_90.json").exists() and (tmp_path / "surface_90.png").exists()


def test_a_soak_that_is_interrupted_keeps_what_was_flown_and_says_so(tmp_path, monkeypatch):
    first, written, left = flights(lambda k: 100.0)[:1], [], flights(lambda k: 100.0)[:1]

    def once(*_):
        if not left:
            raise KeyboardInterrupt
        return left.pop()

    @contextmanager
    def stack(*_):
        yield SimpleNamespace(wait_until_ready=lambda *_: None)

    for name, value in (("Stack", stack), ("MissionClient", lambda: SimpleNamespace(time=0.0, visible_nodes=None, close=lambda: None)),
                        ("domain_in_environment", nullcontext), ("_write", lambda args, code, began, found: written.extend(found)),
                        ("_fly_once", once)):
        monkeypatch.setattr(soak, name, value)
    assert soak.main(["--out", str(tmp_path), "--logs", str(tmp_path)]) == 130 and written == first


def test_a_node_that_ends_is_a_failure_and_what_was_flown_before_it_is_kept(tmp_path, monkeypatch, capsys):
    class Nodes:
        """A stack of which one process ends in the second flight, after it was sampled."""

        flown = 0

        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def wait_until_ready(self, *_):
            pass

        def raise_if_ended(self):
            if self.flown > 1:
                raise soak.StackError("planner ended: killed by SIGSEGV")

        def endings(self):
            return ("planner",) * (self.flown > 1)

        @property
        def pids(self):
            return {"composed": os.getpid()} | ({"planner": os.getpid()} if self.flown < 2 else {})

    def fly(_, check):
        nodes.flown += 1
        check()
        return SimpleNamespace(outcome="perched", message="")

    nodes, drawn = Nodes(), []
    client = SimpleNamespace(time=1.0, visible_nodes=None, close=lambda: None, fly=fly, depart=lambda _: (True, ""))
    for name, value in (("Stack", lambda *_: nodes), ("MissionClient", lambda: client), ("domain_in_environment", nullcontext),
                        ("plot", lambda found, file: drawn.append(len(found)))):
        monkeypatch.setattr(soak, name, value)
    assert soak.main(["--out", str(tmp_path), "--logs", str(tmp_path / "logs"), "--flights", "9"]) == 1 and drawn == [2]
    page = (tmp_path / "README.md").read_text()
    assert "1 of 2 flights perched and departed" in page and "flight 2: failed, no departure: planner ended: killed by SIGSEGV" in page
    assert "| planner |" in page


def test_files_that_vanish_from_shared_memory_have_no_size(tmp_path, monkeypatch):
    (tmp_path / "segment").write_bytes(bytes(3_000_000))
    (tmp_path / "gone").symlink_to(tmp_path / "nowhere")
    monkeypatch.setattr(soak.Path, "is_file", lambda _: True)
    assert soak.shared_memory(tmp_path) == 3.0


def test_equal_problems_are_one_line():
    problems = ["flight 3: missed", "flight 9: missed", "composed: +2.00 MB per 100 flights", "flight 10: timeout"]
    assert soak._grouped(problems) == ["flights 3, 9: missed", "composed: +2.00 MB per 100 flights", "flight 10: timeout"]
