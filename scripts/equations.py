#!/usr/bin/env python3
"""Write docs/equations.md: where each equation of both papers stands in the code."""

from __future__ import annotations

import argparse
import sys

from perch_setup import ROOT, enter


def main() -> int:
    """Write the index; 0 complete, 1 an equation has neither code nor a stated reason."""
    argparse.ArgumentParser(description=__doc__, epilog="example:  python3 scripts/equations.py").parse_args()
    enter()
    from perch_eval.equations import main as write

    return write(ROOT)


if __name__ == "__main__":
    sys.exit(main())
