"""Shared memory: segments that killed nodes leave are removed, everybody else's stay."""

from __future__ import annotations

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
