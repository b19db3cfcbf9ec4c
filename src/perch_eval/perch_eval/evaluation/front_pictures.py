"""Pictures of README.md: flights of the present code, drawn, with their commit below them.

    python3 -m perch_eval.evaluation.front_pictures      fly, draw, and write the commit into README.md
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
from pathlib import Path

from perch_eval.replay import command as replay
from perch_eval.revision import code_version, root

PICTURES = {
    "surface_90.png": (("--scenario", "surface_90"), ()),
    "line_180.png": (("--scenario", "line_180"), ()),
    "betaflight_90.gif": (("--scenario", "surface_90", "--vehicle", "betaflight"), ("--vehicle", "betaflight", "--speed", "0.5", "--fps", "12")),
}
"""File in docs/images -> arguments of demo.py, and of replay.py."""
CAPTION = re.compile(r"Pictures \*\*of commit [^*]+\*\*(?: \(digest [0-9a-f]{12}\))?\.")


def caption() -> str:
    """Return the words of README.md on the code of the pictures."""
    code = code_version()
    return f"Pictures **of commit {code['commit']}** (digest {code['digest']})."


def main(arguments: list[str] | None = None) -> int:
    """Fly and draw each picture, then write the caption; return the exit code, 1 after a flight that did not perch."""
    parser = argparse.ArgumentParser(prog="python3 -m perch_eval.evaluation.front_pictures", description="Make the pictures of README.md anew.")
    parser.add_argument("--out", type=Path, default=Path("out/front_pictures"), metavar="DIR", help="folder of the flights (default: %(default)s)")
    out, words = parser.parse_args(arguments).out, caption()
    for name, (flight, drawing) in PICTURES.items():
        folder = out / Path(name).stem
        if subprocess.run([sys.executable, "-m", "perch_eval.demo", *flight, "--seed", "1", "--out", str(folder)]).returncode:
            return 1
        if replay.main([str(folder), *drawing, "--out", str(root() / "docs" / "images" / name)]):
            return 1
    readme = root() / "README.md"
    readme.write_text(CAPTION.sub(words, readme.read_text(), count=1))
    return 0


if __name__ == "__main__":
    sys.exit(main())
