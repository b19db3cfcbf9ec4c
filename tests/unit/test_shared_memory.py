"""Shared memory: segments that killed nodes leave are removed, everybody else's stay."""

from __future__ import annotations

import fcntl

from perch_eval import shared_memory
from perch_eval.shared_memory import SharedMemory


def test_only_own_unused_segments_are_removed(tmp_path, monkeypatch):
    shm, proc = tmp_path / "shm", tmp_path / "proc"
    monkeypatch.setattr(shared_memory, "_SEGMENT", shared_memory.re.compile(rf"({shm}/(?:sem\.)?fast(?:rtps|dds)_\S+)"))
    shm.mkdir()
    for name in ("fastrtps_mine", "fastrtps_mine_el", "sem.fastrtps_mine_mutex", "sem.fastrtps_port1_mutex",
                 "fastrtps_port1", "fastrtps_foreign", "other_mine"):
        (shm / name).touch()

    def uses(pid: int, *names: str) -> None:
        (proc / str(pid)).mkdir(parents=True, exist_ok=True)
        (proc / str(pid) / "maps").write_text("".join(f"7f00-7f01 rw-s 0 00:1b 6 {shm}/{name}\n" for name in names))

    uses(1, "fastrtps_mine", "fastrtps_port1", "other_mine")
    uses(2, "fastrtps_port1", "fastrtps_foreign")
    memory = SharedMemory(proc)
    memory.observe([1, 99])
    (proc / "1" / "maps").unlink()  # process 1 is killed

    removed = memory.clean()
    assert sorted(removed) == [str(shm / name) for name in ("fastrtps_mine", "fastrtps_mine_el", "sem.fastrtps_mine_mutex")]
    assert sorted(path.name for path in shm.iterdir()) == ["fastrtps_foreign", "fastrtps_port1", "other_mine", "sem.fastrtps_port1_mutex"]

    uses(2)
    assert memory.clean() == [str(shm / "fastrtps_port1"), str(shm / "sem.fastrtps_port1_mutex")]
    assert memory.clean() == []


def test_a_segment_whose_maker_has_ended_is_removed_though_somebody_still_holds_it(tmp_path, monkeypatch):
    shm, proc = tmp_path / "shm", tmp_path / "proc"
    monkeypatch.setattr(shared_memory, "_SEGMENT", shared_memory.re.compile(rf"({shm}/(?:sem\.)?fast(?:rtps|dds)_\S+)"))
    shm.mkdir(), (proc / "1").mkdir(parents=True)
    for name in ("fastrtps_0a", "fastrtps_0a_el", "fastrtps_port7", "fastrtps_port7_el"):
        (shm / name).touch()
    (proc / "1" / "maps").write_text(f"7f00-7f01 rw-s 0 00:1b 6 {shm}/fastrtps_0a\n7f00-7f01 rw-s 0 00:1b 6 {shm}/fastrtps_port7\n")
    memory = SharedMemory(proc)
    memory.observe([1])
    with (shm / "fastrtps_0a_el").open() as lock:  # as its maker does while it lives
        fcntl.flock(lock, fcntl.LOCK_EX)
        assert memory.clean() == []
    assert memory.clean() == [str(shm / "fastrtps_0a"), str(shm / "fastrtps_0a_el")]  # a port is shared: it has no one maker
